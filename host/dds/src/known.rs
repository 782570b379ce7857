//! The definitions of message types: each is looked for once, here and, when somebody wants it, at
//! the node that writes it.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::ask::{Ask, Asked, Outcome};
use super::names::visible;
use super::receive::{Command, Line};
use super::state::State;
use gleaner_base::chain;
use gleaner_messages::described::Described;
use gleaner_messages::{Definitions, MessageError, Sources, SourcesError};

/// How often a type is asked for, at most.
const ASKED: usize = 3;
/// How long the receive thread may take for a question, which has a shorter limit of its own there.
const PATIENCE: Duration = Duration::from_secs(10);
/// Types that are remembered to have no definitions: more than there are topics.
const MOST: usize = 8192;

/// Definitions by type.
#[derive(Debug)]
pub(super) struct Known {
    sources: Sources,
    types: HashMap<String, Entry>,
    open: Option<(Ask, Instant)>,
    tickets: u64,
}

#[derive(Debug)]
enum Entry {
    /// Its text, and what that says once somebody wanted to know.
    Text(Arc<str>, Option<Arc<Definitions>>),
    /// How often nodes were asked, and whether that is all.
    Nowhere { asked: Asked, settled: bool },
}

impl Known {
    pub(super) fn new(sources: Sources) -> Self {
        Self { sources, types: HashMap::new(), open: None, tickets: 0 }
    }

    /// The text of a type's definitions, if there is one.
    pub(super) fn text(&mut self, type_name: &str) -> Option<Arc<str>> {
        match self.entry(type_name) {
            Entry::Text(text, _) => Some(text.clone()),
            Entry::Nowhere { .. } => None,
        }
    }

    /// A type's definitions, if there are some; the same for all who ask.
    pub(super) fn parsed(
        &mut self,
        type_name: &str,
    ) -> Result<Option<Arc<Definitions>>, MessageError> {
        let Entry::Text(text, parsed) = self.entry(type_name) else { return Ok(None) };
        if parsed.is_none() {
            *parsed = Some(Arc::new(Definitions::parse(type_name, text)?));
        }
        Ok(parsed.clone())
    }

    /// Whether it is worth while to look again for a type that had no definitions. If nobody was
    /// asked yet, somebody is now.
    pub(super) fn may_come(&mut self, type_name: &str, line: &Line, state: &State) -> bool {
        self.collect(state);
        let before = match self.entry(type_name) {
            Entry::Text(..) => return true,
            Entry::Nowhere { asked, settled } if *settled || asked.times >= ASKED => {
                return false;
            }
            Entry::Nowhere { asked, .. } => *asked,
        };
        // One question at a time.
        if self.open.is_none() {
            self.tickets += 1;
            let ask = Ask { ticket: self.tickets, type_name: type_name.to_owned(), before };
            line.send(Command::Ask(ask.clone()));
            self.open = Some((ask, Instant::now()));
        }
        true
    }

    /// Takes the outcome of the open question, if there is one.
    fn collect(&mut self, state: &State) {
        let Some((ask, since)) = &self.open else { return };
        let late = || {
            let why = "the receive thread does not answer".to_owned();
            (since.elapsed() >= PATIENCE).then_some(Outcome::Silence { why, again: false })
        };
        let Some(outcome) = state.answered(ask.ticket).or_else(late) else { return };
        let ask = ask.clone();
        self.open = None;
        let type_name = &ask.type_name;
        let mut asked = Asked { times: ask.before.times + 1, ..ask.before };
        let entry = match outcome {
            Outcome::Silence { why, again } => {
                asked.in_vain += 1;
                warn!(type_name, why, asked = asked.times, "no node says what this type is");
                Entry::Nowhere { asked, settled: !again }
            }
            Outcome::Answer { node, hash, cdr, endian } => {
                match Described::read(type_name, &hash, &cdr, endian) {
                    Ok(Described { text, without_texts }) => {
                        let comments = without_texts
                            .map_or("as their author wrote them".to_owned(), |why| visible(&why));
                        info!(
                            type_name,
                            node, hash, comments, "definitions from a node that writes this type"
                        );
                        Entry::Text(text, None)
                    }
                    Err(error) => {
                        let error = visible(&chain(&error));
                        warn!(
                            type_name,
                            node,
                            error,
                            asked = asked.times,
                            "what a node says of this type cannot be used"
                        );
                        Entry::Nowhere { asked, settled: false }
                    }
                }
            }
        };
        self.types.insert(ask.type_name, entry);
    }

    fn entry(&mut self, type_name: &str) -> &mut Entry {
        if self.types.len() >= MOST && !self.types.contains_key(type_name) {
            // Names from the network. What has a text is of this vehicle's own, or was asked for.
            self.types.retain(|_, entry| {
                !matches!(entry, Entry::Nowhere { asked: Asked { times: 0, .. }, .. })
            });
        }
        self.types.entry(type_name.to_owned()).or_insert_with(|| {
            match self.sources.find(type_name) {
                Ok(Some(text)) => Entry::Text(text, None),
                Ok(None) | Err(SourcesError::Name { .. }) => {
                    Entry::Nowhere { asked: Asked::default(), settled: false }
                }
                Err(error) => {
                    warn!(
                        type_name,
                        error = &error as &dyn std::error::Error,
                        "definitions that cannot be used"
                    );
                    Entry::Nowhere { asked: Asked::default(), settled: false }
                }
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_looked_for_once_whether_it_is_found_or_not() {
        let folder = std::env::temp_dir().join(format!("gleaner-known-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let mut known = Known::new(Sources::new(std::slice::from_ref(&folder), &[]));
        assert_eq!(known.text("car_msgs/msg/Wheel"), None);
        std::fs::write(folder.join("Wheel.msg"), "float64 bar\n").unwrap();
        let late = known.text("car_msgs/msg/Wheel");
        let anew = Known::new(known.sources.clone()).text("car_msgs/msg/Wheel");
        std::fs::remove_dir_all(&folder).unwrap();
        assert_eq!((late, anew.as_deref()), (None, Some("float64 bar\n")));
        let text = known.text("std_msgs/msg/String").unwrap();
        assert!(Arc::ptr_eq(&text, &known.text("std_msgs/msg/String").unwrap()));
        let mut parsed = || known.parsed("std_msgs/msg/String").unwrap().unwrap();
        assert!(Arc::ptr_eq(&parsed(), &parsed()));
    }

    #[test]
    fn names_from_the_network_do_not_add_up() {
        let mut known = Known::new(Sources::default());
        assert!(known.text("std_msgs/msg/String").is_some());
        for n in 0..3 * MOST {
            assert_eq!(known.text(&format!("car_msgs/msg/T{n}")), None);
        }
        assert!(known.types.len() <= MOST && known.types.contains_key("std_msgs/msg/String"));
    }
}
