//! Inputs whose samples the ingress writes to shared memory.

use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_buffers::RingReader;
use gleaner_lambda::manifest::{InputSpec, Manifest};
use gleaner_messages::transport::{StoredMeta, TopicCounters, TransportError};
use gleaner_messages::type_description::type_hash;
use gleaner_messages::{Definitions, Sources, SourcesError};
use gleaner_protocol::ingress::{RefusedTopic, TopicGrant};
use gleaner_samples::{Feed, FeedError, SharedTopicReader};
use tracing::warn;

use super::{InputError, Remap, SharedLimits, warn_of_missing_definitions};
use crate::api::data::{InputRing, SumsBefore, Topic};

/// Time to wait for a granted topic: the ingress subscribes it at once.
const ATTACH_TIMEOUT: Duration = Duration::from_secs(60);
/// Time that a start may wait for definitions from other nodes, for all inputs together.
const QUERY_TIMEOUT: Duration = Duration::from_secs(6);

/// Attaches every input of `manifest`, whose index in the manifest is the id of its topic, and
/// returns the topics in the manifest's order. Message definitions come from the recording of the
/// samples, from `sources`, or from the nodes that write the topic, in this order.
pub fn open_fed_inputs(
    manifest: &Manifest,
    remaps: &[Remap],
    feed: &mut Feed,
    sources: &Sources,
) -> Result<Vec<Arc<Topic>>, InputError> {
    let shared = SharedLimits::of(manifest);
    let query_until = Instant::now() + QUERY_TIMEOUT;
    let inputs = manifest.inputs.iter().zip(0..).map(|(input, id)| {
        let on_network = Remap::apply(remaps, input.topic.as_str());
        let attached = feed.topic(id, ATTACH_TIMEOUT);
        let attached = attached.map_err(|error| refused(input, on_network, error))?;
        let received = |source| InputError::Receive { input: input.name.to_string(), source };
        let known = attached.definitions(|| local_definitions(sources, input.type_name.as_str()));
        let SharedTopicReader { info, reader } = attached;
        let text = match known {
            Some(text) => Some(text),
            None => {
                let left = query_until.saturating_duration_since(Instant::now());
                match feed.definitions(id, left) {
                    Err(FeedError::Silent { .. }) => None,
                    answer => answer.map_err(received)?,
                }
            }
        };
        // While no writer has announced a layout, samples with one wait for their confirmation.
        let own = || type_hash(&info.type_name, text.as_deref()?).ok();
        let layout = match (&info.type_hash, info.is_recorded) {
            (_, true) => None,
            (Some(announced), _) => Some((announced.clone(), true)),
            (None, _) => own().map(|own| (own, false)),
        };
        let definitions = parse(input, on_network, text)?;
        let granted = TopicGrant::for_input(id, input, on_network, false, false).depth;
        let ring = InputRing {
            reader: RingReader::shared(
                reader,
                info.first,
                granted as usize,
                StoredMeta::of_words,
                |reader| TopicCounters::of_words(&reader.counters()).too_big,
                info.refused,
            ),
            depth: input.depth,
            sums_digests: Arc::default(),
            sums_before: SumsBefore { digest: info.digests, refused: info.refused },
        };
        let topic = shared.topic(input, ring, definitions)?;
        layout.into_iter().for_each(|layout| topic.live_layout.set(layout));
        topic.hide_unconfirmed();
        Ok(topic)
    });
    inputs.collect()
}

/// Continues an input in the memory of an ingress that was started again.
///
/// # Errors
///
/// [`FeedError::Refused`] if its writers announce another layout now.
pub(crate) fn continue_fed_input(
    topic: &Topic,
    SharedTopicReader { info, reader }: SharedTopicReader,
) -> Result<(), FeedError> {
    topic
        .check_layout(info.type_hash.as_deref())
        .map_err(|why| FeedError::refused(info.id, RefusedTopic::Other(vec![why])))?;
    let before = SumsBefore { digest: info.digests, refused: info.refused };
    topic.continue_in(reader, info.first, before);
    Ok(())
}

/// Returns the error of an input whose topic is not attached.
fn refused(input: &InputSpec, on_network: &str, error: FeedError) -> InputError {
    let (name, topic) = (input.name.to_string(), on_network.to_owned());
    match error {
        FeedError::Refused { reason: RefusedTopic::NoSuchTopic { known, nearest }, .. } => {
            let source = TransportError::NoSuchTopic { topic, known, nearest };
            InputError::Subscribe { input: name, source }
        }
        FeedError::Refused { reason: RefusedTopic::WrongType { found }, .. } => {
            let wanted = input.type_name.to_string();
            let source = TransportError::WrongType { topic, wanted, found };
            InputError::Subscribe { input: name, source }
        }
        source => InputError::Receive { input: name, source },
    }
}

/// Returns the text of a type's definitions on this machine. An unusable file is logged: another
/// source may have the type.
fn local_definitions(sources: &Sources, type_name: &str) -> Option<String> {
    match sources.find(type_name) {
        Ok(text) => text.map(|text| text.to_string()),
        Err(SourcesError::Name { .. }) => None,
        Err(error) => {
            let error = &error as &dyn std::error::Error;
            warn!(type_name, error, "unusable definition file");
            None
        }
    }
}

fn parse(
    input: &InputSpec,
    on_network: &str,
    text: Option<String>,
) -> Result<Option<Arc<Definitions>>, InputError> {
    let type_name = input.type_name.as_str();
    let Some(text) = text else {
        warn_of_missing_definitions(input, type_name);
        return Ok(None);
    };
    match Definitions::parse(type_name, &text) {
        Ok(definitions) => Ok(Some(Arc::new(definitions))),
        Err(source) => {
            let source = TransportError::BadDefinitions { topic: on_network.to_owned(), source };
            Err(InputError::Subscribe { input: input.name.to_string(), source })
        }
    }
}
