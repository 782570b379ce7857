//! Caches the definitions of message types: each is searched once, locally and, on demand, at a
//! node that writes the type. Writers that announce another hash than that of the local definition
//! have another layout, of which only such a node has the definition.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustdds::DomainParticipant;
use tracing::{info, warn};

use super::discovery;
use super::names::{dds_type, visible};
use super::qos::Offer;
use super::receive::{ReceiverCommand, ReceiverHandle};
use super::state::ParticipantState;
use super::type_query::{Attempts, QueryOutcome, Retry, TypeQuery};
use gleaner_base::chain;
use gleaner_messages::transport::DefinitionsSearch;
use gleaner_messages::type_description::{DescribedDefinitions, type_hash};
use gleaner_messages::{Definitions, MessageError, Sources, SourcesError};

/// Most queries for one type that are sent to a node.
const MAX_QUERIES: usize = 3;
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

const HELP: &str = "put the publisher's `.msg` files into the `msg` folder of the lambda";

/// A type, and the hash of its layout if its writers announce one.
type TypeKey = (String, Option<String>);

#[derive(Debug)]
pub(super) struct DefinitionsCache {
    sources: Sources,
    types: HashMap<TypeKey, CachedType>,
    open: Option<(TypeQuery, Instant)>,
    tickets: u64,
    since: Instant,
    /// The types of all writers, as DDS names them, with the hashes that they announce; and when
    /// they were listed.
    written: Option<(HashMap<String, Vec<String>>, Instant)>,
}

#[derive(Debug)]
enum CachedType {
    /// The text, its parsed form once a caller needed it, and the hash of the type.
    Text(Arc<str>, Option<Arc<Definitions>>, Option<String>),
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

    /// The text of a type's definitions in the layout with `hash`, if there is one; without `hash`,
    /// the local one.
    pub(super) fn text(&mut self, type_name: &str, hash: Option<&str>) -> Option<Arc<str>> {
        match self.entry(type_name, hash) {
            CachedType::Text(text, ..) => Some(text.clone()),
            CachedType::Missing(_) => None,
        }
    }

    /// The hash of the local definition of a type, if there is one.
    pub(super) fn hash_at_hand(&mut self, type_name: &str) -> Option<String> {
        match self.entry(type_name, None) {
            CachedType::Text(_, _, hash) => hash.clone(),
            CachedType::Missing(_) => None,
        }
    }

    /// The same as [`text`](Self::text), parsed; shared by all callers.
    pub(super) fn parsed(
        &mut self,
        type_name: &str,
        hash: Option<&str>,
    ) -> Result<Option<Arc<Definitions>>, MessageError> {
        let CachedType::Text(text, parsed, _) = self.entry(type_name, hash) else {
            return Ok(None);
        };
        if parsed.is_none() {
            *parsed = Some(Arc::new(Definitions::parse(type_name, text)?));
        }
        Ok(parsed.clone())
    }

    /// Returns whether definitions that are missing now, of any layout that is written, may still
    /// come. Starts a query if there is none, and if the type has a writer.
    pub(super) fn search(
        &mut self,
        type_name: &str,
        participant: &DomainParticipant,
        receiver: &ReceiverHandle,
        state: &ParticipantState,
    ) -> DefinitionsSearch {
        self.collect(state);
        let now = Instant::now();
        // Nodes describe types of services and actions, too, which no `.msg` text can express.
        let Some(name) = dds_type(type_name).filter(|name| name.contains("::msg::")) else {
            return DefinitionsSearch::Ended;
        };
        let Some(announced) = self.written(&name, participant, now) else {
            // Not remembered: a writer may start at any time.
            let may_come = now < self.since + DISCOVERY || self.text(type_name, None).is_some();
            return if may_come { DefinitionsSearch::Waiting } else { DefinitionsSearch::Ended };
        };
        let mut search = DefinitionsSearch::Waiting;
        for type_hash in announced {
            let CachedType::Missing(missing) = self.entry(type_name, type_hash.as_deref()) else {
                continue;
            };
            let Missing { attempts: before, settled, pause } = *missing;
            if settled || before.times >= MAX_QUERIES || pause.is_some_and(|until| now < until) {
                search = DefinitionsSearch::Ended;
                continue;
            }
            // One query at a time.
            if self.open.is_some() {
                return DefinitionsSearch::Waiting;
            }
            self.tickets += 1;
            let (ticket, type_name) = (self.tickets, type_name.to_owned());
            let query = TypeQuery { ticket, type_name, type_hash, before };
            receiver.send(ReceiverCommand::Query(query.clone()));
            self.open = Some((query, now));
            return DefinitionsSearch::Started;
        }
        search
    }

    /// The hashes that writers of a type announce, or `None` as the only one; `None` if there is no
    /// writer.
    fn written(
        &mut self,
        dds_type: &str,
        participant: &DomainParticipant,
        now: Instant,
    ) -> Option<Vec<Option<String>>> {
        self.written.take_if(|(_, at)| now >= *at + WRITTEN);
        let (types, _) = self.written.get_or_insert_with(|| {
            let mut types: HashMap<String, Vec<String>> = HashMap::new();
            for writer in participant.discovered_writers() {
                let Offer { type_name, type_hash, .. } = discovery::offer(&writer);
                let hashes = types.entry(type_name).or_default();
                hashes.extend(type_hash.filter(|hash| !hashes.contains(hash)));
            }
            (types, now)
        });
        let hashes = types.get(dds_type)?;
        Some(if hashes.is_empty() {
            vec![None]
        } else {
            hashes.iter().cloned().map(Some).collect()
        })
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
        let at_hand = self.hash_at_hand(type_name);
        let mut attempts = Attempts { times: query.before.times + 1, ..query.before };
        let entry = match outcome {
            QueryOutcome::Failed { why, retry: Retry::Unsent } => {
                info!(
                    type_name,
                    why, "cannot ask a node for the definition of this type yet; will retry"
                );
                let pause = Some(Instant::now() + PAUSE);
                CachedType::Missing(Missing { attempts: query.before, settled: false, pause })
            }
            QueryOutcome::Failed { why, retry } => {
                attempts.unanswered += 1;
                warn!(
                    type_name,
                    announced = query.type_hash,
                    at_hand,
                    why,
                    attempts = attempts.times,
                    help = HELP,
                    "no node provides the definition of this type"
                );
                CachedType::Missing(Missing { attempts, settled: retry == Retry::No, pause: None })
            }
            QueryOutcome::Answer { node, hash, cdr, endian } => {
                match DescribedDefinitions::read(type_name, &hash, &cdr, endian) {
                    Ok(described) => self.found(&query, &node, hash, described, at_hand.is_none()),
                    Err(error) => {
                        let error = visible(&chain(&error));
                        warn!(
                            type_name,
                            node,
                            announced = hash,
                            at_hand,
                            error,
                            attempts = attempts.times,
                            help = HELP,
                            "the definition that a node sent for this type is unusable"
                        );
                        CachedType::Missing(Missing { attempts, ..Missing::default() })
                    }
                }
            }
        };
        self.types.insert((query.type_name, query.type_hash), entry);
    }

    /// Returns the entry of the definitions that `node` sent; if there is `no_local` one, they are
    /// also those of writers that announce no hash.
    fn found(
        &mut self,
        query: &TypeQuery,
        node: &str,
        hash: String,
        DescribedDefinitions { text, without_texts }: DescribedDefinitions,
        no_local: bool,
    ) -> CachedType {
        let type_name = &query.type_name;
        let comments =
            without_texts.map_or("as their author wrote them".to_owned(), |why| visible(&why));
        info!(type_name, node, hash, comments, "received definitions from a writer of this type");
        let entry = || CachedType::Text(text.clone(), None, Some(hash.clone()));
        if no_local {
            self.types.insert((type_name.clone(), None), entry());
        }
        entry()
    }

    fn entry(&mut self, type_name: &str, hash: Option<&str>) -> &mut CachedType {
        let key = (type_name.to_owned(), hash.map(str::to_owned));
        if self.types.len() >= MOST && !self.types.contains_key(&key) {
            // Forgets names from the network. Types with a text are this vehicle's own, or were
            // queried.
            self.types.retain(|_, entry| {
                !matches!(entry, CachedType::Missing(missing) if missing.attempts.times == 0)
            });
        }
        self.types.entry(key).or_insert_with(|| match self.sources.find(type_name) {
            Ok(Some(text)) => {
                let local = type_hash(type_name, &text).ok();
                if hash.is_none() || hash == local.as_deref() {
                    return CachedType::Text(text, None, local);
                }
                CachedType::Missing(Missing::default())
            }
            Ok(None) | Err(SourcesError::Name { .. }) => CachedType::Missing(Missing::default()),
            Err(error) => {
                warn!(
                    type_name,
                    error = &error as &dyn std::error::Error,
                    "unusable definition file"
                );
                CachedType::Missing(Missing::default())
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
        assert_eq!(cache.text("car_msgs/msg/Wheel", None), None);
        std::fs::write(folder.join("Wheel.msg"), "float64 bar\n").unwrap();
        let late = cache.text("car_msgs/msg/Wheel", None);
        let again = DefinitionsCache::new(cache.sources.clone()).text("car_msgs/msg/Wheel", None);
        std::fs::remove_dir_all(&folder).unwrap();
        assert_eq!((late, again.as_deref()), (None, Some("float64 bar\n")));
        let text = cache.text("std_msgs/msg/String", None).unwrap();
        assert!(Arc::ptr_eq(&text, &cache.text("std_msgs/msg/String", None).unwrap()));
        let hash = cache.hash_at_hand("std_msgs/msg/String");
        assert_eq!(cache.text("std_msgs/msg/String", hash.as_deref()), Some(text));
        assert_eq!(cache.text("std_msgs/msg/String", Some("RIHS01_0")), None);
        let mut parsed = || cache.parsed("std_msgs/msg/String", None).unwrap().unwrap();
        assert!(Arc::ptr_eq(&parsed(), &parsed()));
    }

    #[test]
    fn names_from_the_network_do_not_accumulate() {
        let mut cache = DefinitionsCache::new(Sources::default());
        assert!(cache.text("std_msgs/msg/String", None).is_some());
        for n in 0..3 * MOST {
            assert_eq!(cache.text(&format!("car_msgs/msg/T{n}"), Some("RIHS01_0")), None);
        }
        let string = ("std_msgs/msg/String".to_owned(), None);
        assert!(cache.types.len() <= MOST && cache.types.contains_key(&string));
    }
}
