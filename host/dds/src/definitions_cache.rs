//! Caches the definitions of message types: each is searched once, locally and, on demand, at a
//! node that writes the type.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustdds::DomainParticipant;
use tracing::{info, warn};

use super::names::{dds_type, visible};
use super::receive::{ReceiverCommand, ReceiverHandle};
use super::state::ParticipantState;
use super::type_query::{Attempts, QueryOutcome, Retry, TypeQuery};
use gleaner_base::chain;
use gleaner_messages::type_description::DescribedDefinitions;
use gleaner_messages::{Definitions, MessageError, Sources, SourcesError};
use gleaner_transport::DefinitionsSearch;

/// Most queries for one type that are sent to a node.
const MOST_QUERIES: usize = 3;
/// Time that the receive thread may take for a query, which has a shorter limit of its own there.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Time after the start in which a writer may exist that is not discovered yet.
const DISCOVERY: Duration = Duration::from_secs(2);
/// Interval in which the types of writers are listed.
const WRITTEN: Duration = Duration::from_millis(100);
/// Time without queries for a type after one that was sent to no node.
const PAUSE: Duration = Duration::from_secs(10);
/// Most types that are remembered to have no definitions: more than there are topics.
const MOST: usize = 8192;

/// Definitions by type.
#[derive(Debug)]
pub(super) struct DefinitionsCache {
    sources: Sources,
    types: HashMap<String, CachedType>,
    open: Option<(TypeQuery, Instant)>,
    tickets: u64,
    since: Instant,
    /// The types of all writers, as DDS names them, and the time of this list.
    written: Option<(HashSet<String>, Instant)>,
}

#[derive(Debug)]
enum CachedType {
    /// The text, and its parsed form once a caller needed it.
    Text(Arc<str>, Option<Arc<Definitions>>),
    Missing(Missing),
}

/// The queries for a type so far.
#[derive(Copy, Clone, Debug, Default)]
struct Missing {
    attempts: Attempts,
    /// True if there will be no more.
    settled: bool,
    /// There will be none until then.
    pause: Option<Instant>,
}

impl DefinitionsCache {
    pub(super) fn new(sources: Sources) -> Self {
        let since = Instant::now();
        Self { sources, types: HashMap::new(), open: None, tickets: 0, since, written: None }
    }

    /// The text of a type's definitions, if there is one.
    pub(super) fn text(&mut self, type_name: &str) -> Option<Arc<str>> {
        match self.entry(type_name) {
            CachedType::Text(text, _) => Some(text.clone()),
            CachedType::Missing(_) => None,
        }
    }

    /// The parsed definitions of a type, if there are any; shared by all callers.
    pub(super) fn parsed(
        &mut self,
        type_name: &str,
    ) -> Result<Option<Arc<Definitions>>, MessageError> {
        let CachedType::Text(text, parsed) = self.entry(type_name) else { return Ok(None) };
        if parsed.is_none() {
            *parsed = Some(Arc::new(Definitions::parse(type_name, text)?));
        }
        Ok(parsed.clone())
    }

    /// Returns whether definitions that are missing now may still come. Starts a query if there is
    /// none, and if the type has a writer.
    pub(super) fn search(
        &mut self,
        type_name: &str,
        participant: &DomainParticipant,
        receiver: &ReceiverHandle,
        state: &ParticipantState,
    ) -> DefinitionsSearch {
        self.collect(state);
        let Missing { attempts: before, settled, pause } = match self.entry(type_name) {
            CachedType::Text(..) => return DefinitionsSearch::Waiting,
            CachedType::Missing(missing) => *missing,
        };
        let now = Instant::now();
        if settled || before.times >= MOST_QUERIES || pause.is_some_and(|until| now < until) {
            return DefinitionsSearch::Ended;
        }
        if !self.is_written(type_name, participant, now) {
            // Not remembered: a writer may start at any time.
            let is_young = now < self.since + DISCOVERY;
            return if is_young { DefinitionsSearch::Waiting } else { DefinitionsSearch::Ended };
        }
        // One query at a time.
        if self.open.is_some() {
            return DefinitionsSearch::Waiting;
        }
        self.tickets += 1;
        let query = TypeQuery { ticket: self.tickets, type_name: type_name.to_owned(), before };
        receiver.send(ReceiverCommand::Query(query.clone()));
        self.open = Some((query, now));
        DefinitionsSearch::Started
    }

    /// Returns whether there is a writer of a type.
    fn is_written(
        &mut self,
        type_name: &str,
        participant: &DomainParticipant,
        now: Instant,
    ) -> bool {
        let Some(name) = dds_type(type_name) else { return false };
        self.written.take_if(|(_, at)| now >= *at + WRITTEN);
        let (types, _) = self.written.get_or_insert_with(|| {
            let writers = participant.discovered_writers().into_iter();
            (writers.map(|writer| writer.publication_topic_data.type_name).collect(), now)
        });
        types.contains(&name)
    }

    /// Takes the outcome of the open query, if there is one.
    fn collect(&mut self, state: &ParticipantState) {
        let Some((query, since)) = &self.open else { return };
        let late = || {
            let why = "the receive thread does not answer".to_owned();
            (since.elapsed() >= TIMEOUT).then_some(QueryOutcome::Failed { why, retry: Retry::No })
        };
        let Some(outcome) = state.answered(query.ticket).or_else(late) else { return };
        let query = query.clone();
        self.open = None;
        let type_name = &query.type_name;
        let mut attempts = Attempts { times: query.before.times + 1, ..query.before };
        let entry = match outcome {
            QueryOutcome::Failed { why, retry: Retry::Unsent } => {
                info!(type_name, why, "no node can be asked for the definition of this type yet");
                let pause = Some(Instant::now() + PAUSE);
                CachedType::Missing(Missing { attempts: query.before, settled: false, pause })
            }
            QueryOutcome::Failed { why, retry } => {
                attempts.unanswered += 1;
                warn!(
                    type_name,
                    why,
                    attempts = attempts.times,
                    "no node provides the definition of this type"
                );
                CachedType::Missing(Missing { attempts, settled: retry == Retry::No, pause: None })
            }
            QueryOutcome::Answer { node, hash, cdr, endian } => {
                match DescribedDefinitions::read(type_name, &hash, &cdr, endian) {
                    Ok(DescribedDefinitions { text, without_texts }) => {
                        let comments = without_texts
                            .map_or("as their author wrote them".to_owned(), |why| visible(&why));
                        info!(
                            type_name,
                            node, hash, comments, "definitions from a node that writes this type"
                        );
                        CachedType::Text(text, None)
                    }
                    Err(error) => {
                        let error = visible(&chain(&error));
                        warn!(
                            type_name,
                            node,
                            error,
                            attempts = attempts.times,
                            "the definition that a node sent for this type is unusable"
                        );
                        CachedType::Missing(Missing { attempts, ..Missing::default() })
                    }
                }
            }
        };
        self.types.insert(query.type_name, entry);
    }

    fn entry(&mut self, type_name: &str) -> &mut CachedType {
        if self.types.len() >= MOST && !self.types.contains_key(type_name) {
            // Forgets names from the network. Types with a text are this vehicle's own, or were
            // queried.
            self.types.retain(|_, entry| {
                !matches!(entry, CachedType::Missing(missing) if missing.attempts.times == 0)
            });
        }
        self.types.entry(type_name.to_owned()).or_insert_with(|| {
            match self.sources.find(type_name) {
                Ok(Some(text)) => CachedType::Text(text, None),
                Ok(None) | Err(SourcesError::Name { .. }) => {
                    CachedType::Missing(Missing::default())
                }
                Err(error) => {
                    warn!(
                        type_name,
                        error = &error as &dyn std::error::Error,
                        "unusable definition file"
                    );
                    CachedType::Missing(Missing::default())
                }
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_searched_once_whether_it_is_found_or_not() {
        let folder = std::env::temp_dir().join(format!("gleaner-known-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let mut cache = DefinitionsCache::new(Sources::new(std::slice::from_ref(&folder), &[]));
        assert_eq!(cache.text("car_msgs/msg/Wheel"), None);
        std::fs::write(folder.join("Wheel.msg"), "float64 bar\n").unwrap();
        let late = cache.text("car_msgs/msg/Wheel");
        let again = DefinitionsCache::new(cache.sources.clone()).text("car_msgs/msg/Wheel");
        std::fs::remove_dir_all(&folder).unwrap();
        assert_eq!((late, again.as_deref()), (None, Some("float64 bar\n")));
        let text = cache.text("std_msgs/msg/String").unwrap();
        assert!(Arc::ptr_eq(&text, &cache.text("std_msgs/msg/String").unwrap()));
        let mut parsed = || cache.parsed("std_msgs/msg/String").unwrap().unwrap();
        assert!(Arc::ptr_eq(&parsed(), &parsed()));
    }

    #[test]
    fn names_from_the_network_do_not_accumulate() {
        let mut cache = DefinitionsCache::new(Sources::default());
        assert!(cache.text("std_msgs/msg/String").is_some());
        for n in 0..3 * MOST {
            assert_eq!(cache.text(&format!("car_msgs/msg/T{n}")), None);
        }
        assert!(cache.types.len() <= MOST && cache.types.contains_key("std_msgs/msg/String"));
    }
}
