//! Where samples are held: one ring for each input of the manifest, filled from the transport's
//! thread.
//!
//! All memory is taken and touched here, before the first sample. Delivering copies a sample once
//! and never waits for a lambda.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

use gleaner_buffers::{Draft, Pool, PoolError, Refusal, RingWriter, ring};
use gleaner_lambda::manifest::{self, Durability, Input, Manifest, Reliability};
use gleaner_transport::{Qos, SampleMeta, Sink, TopicSpec, Transport, TransportError, Verdict};

use tracing::warn;

use crate::api::data::{PerCall, Topic};
use crate::api::frame::{Budget, Images};
use crate::api::trace::Arrivals;
use crate::memory::Mapping;

/// Why an input could not be set up.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum InputError {
    #[error("cannot lay out the memory of input `{input}`")]
    Layout { input: String, source: PoolError },
    #[error("cannot reserve {bytes} bytes of memory for input `{input}`")]
    Memory { input: String, bytes: usize, source: io::Error },
    #[error("cannot subscribe input `{input}`")]
    Subscribe { input: String, source: TransportError },
}

/// A topic's new name at run time, as in ROS: `--remap FROM:=TO`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Remap {
    /// Topic in the manifest.
    pub from: String,
    /// Topic in the drive or on the wire.
    pub to: String,
}

impl Remap {
    /// The name of `topic` in the drive or on the wire.
    pub fn apply<'a>(remaps: &'a [Remap], topic: &'a str) -> &'a str {
        remaps.iter().find(|remap| remap.from == topic).map_or(topic, |remap| &remap.to)
    }
}

/// Wakes the thread that waits for samples of one input.
#[derive(Clone, Debug)]
pub struct Bell {
    /// The input.
    pub input: String,
    /// Who waits.
    pub thread: Thread,
}

/// What differs where samples arrive while the lambda runs.
#[derive(Clone, Debug)]
pub struct Live {
    /// Whom samples of the input that wakes the lambda wake, if one does.
    pub bell: Option<Bell>,
}

/// Samples up to this size are small: a ring has room for as many again as it shows.
const SMALL_BYTES: u64 = 64 << 10;
/// As many large samples may arrive during a wake without one leaving that it may see.
const SPARE_LARGE: usize = 2;

/// How much deeper a ring is than the lambda sees, so that what it may see does not leave while it
/// runs.
fn spare(input: &Input) -> usize {
    if input.max_size.bytes() <= SMALL_BYTES { input.depth } else { input.depth.min(SPARE_LARGE) }
}

/// Bytes beside the rings that a process takes on a vehicle at most: decisions that wait to be
/// written, and messages that the network puts together.
pub fn unfinished_bytes(manifest: &Manifest) -> u64 {
    const LINES: u64 = 48 << 20;
    // So many unfinished messages does RustDDS keep of a writer, and where memory is refused to it,
    // it ends the process.
    const MESSAGES: u64 = 130;
    let sizes = manifest.inputs.iter().map(|input| input.max_size.bytes().saturating_mul(MESSAGES));
    sizes.fold(LINES, u64::saturating_add)
}

/// Slots for the samples of an input on a vehicle: one more is for the newest of those that a wake
/// sees, which is held while it runs.
pub fn live_slots(input: &Input) -> usize {
    input.slots() + spare(input) + 1
}

/// Subscribes every input of `manifest` and returns its topics, in the manifest's order.
///
/// # Errors
///
/// [`InputError`] names the input.
pub fn open_inputs(
    manifest: &Manifest,
    remaps: &[Remap],
    transport: &mut dyn Transport,
    live: Option<&Live>,
) -> Result<Vec<Arc<Topic>>, InputError> {
    let limits = &manifest.limits;
    let frames = usize::try_from(limits.frames).unwrap_or(usize::MAX);
    let shared = Shared {
        made: Budget::new(frames, limits.memory.as_usize()),
        per_call: PerCall::new(limits),
        ask_until: Instant::now() + ASK_ALL,
    };
    manifest
        .inputs
        .iter()
        .map(|input| open_input(input, remaps, transport, live, &shared))
        .collect()
}

/// What all inputs of a lambda have together.
struct Shared {
    /// Until when nodes are asked what is not known here.
    ask_until: Instant,
    made: Budget,
    per_call: PerCall,
}

fn open_input(
    input: &Input,
    remaps: &[Remap],
    transport: &mut dyn Transport,
    live: Option<&Live>,
    shared: &Shared,
) -> Result<Arc<Topic>, InputError> {
    let layout = |source| InputError::Layout { input: input.name.to_string(), source };
    let subscribe = |source| InputError::Subscribe { input: input.name.to_string(), source };

    let topic = input.topic.as_str();
    let wire_topic = Remap::apply(remaps, topic);
    let spec = TopicSpec {
        topic: wire_topic.to_owned(),
        type_name: input.type_name.to_string(),
        queue: input.depth,
        max_bytes: input.max_size.as_usize(),
        qos: qos(input.qos),
    };

    let spare = live.map_or(0, |_| spare(input));
    let slots = live.map_or(input.slots(), |_| live_slots(input));
    let samples = pool(input, slots, spec.max_bytes)?;
    let (writer, reader) = ring(samples, input.depth + spare).map_err(layout)?;
    let decoded = match input.decoded_size {
        Some(bytes) => Some(pool(input, input.decoded_slots(), bytes.as_usize())?),
        None => None,
    };
    let images = (Images::new(decoded, shared.made.clone()), shared.per_call.clone());
    let arrivals = Arc::new(Arrivals::new(input.depth + spare));
    let ingest = Arc::new(Ingest {
        end: Mutex::new(End { ring: writer, copied: None }),
        arrivals: arrivals.clone(),
        input: input.name.to_string(),
        topic: spec.topic.clone(),
        refused: Default::default(),
        bell: live
            .and_then(|live| live.bell.clone())
            .filter(|bell| bell.input == input.name.as_str()),
    });
    transport.subscribe(&spec, ingest).map_err(subscribe)?;
    // Whoever writes a topic that is there already can say what it is, if nobody here can.
    let found = loop {
        match transport.definitions(&spec.topic) {
            Err(TransportError::NoDefinitions { .. })
                if Instant::now() < shared.ask_until
                    && transport.definitions_may_come(&spec.topic) =>
            {
                std::thread::sleep(ASK_EVERY);
            }
            found => break found,
        }
    };
    let definitions = match found {
        Ok(definitions) => Some(definitions),
        Err(TransportError::NoDefinitions { type_name, .. }) => {
            warn!(input = %input.name, r#type = %type_name, "no message definitions: fields of this input cannot be read");
            None
        }
        Err(error) => return Err(subscribe(error)),
    };
    Ok(Topic::new(
        input.name.as_str(),
        topic,
        &spec.type_name,
        (reader, input.depth),
        arrivals,
        definitions,
        images,
    ))
}

fn qos(qos: manifest::Qos) -> Qos {
    match qos {
        manifest::Qos::Auto => Qos::Auto,
        manifest::Qos::Fixed { reliability, durability, depth } => Qos::Fixed {
            reliable: reliability == Reliability::Reliable,
            transient_local: durability == Durability::TransientLocal,
            depth,
        },
    }
}

fn pool<M: Copy + Send + Sync + 'static>(
    input: &Input,
    slots: usize,
    slot_bytes: usize,
) -> Result<Pool<M>, InputError> {
    let name = || input.name.to_string();
    let layout = |source| InputError::Layout { input: name(), source };
    let bytes =
        Pool::<M>::bytes_needed(slots, slot_bytes).ok_or(PoolError::TooLarge { slots, slot_bytes });
    let bytes = bytes.map_err(layout)?;
    let region = Mapping::populated(bytes).map_err(|source| InputError::Memory {
        input: name(),
        bytes,
        source,
    })?;
    Pool::new(region, slots, slot_bytes).map_err(layout)
}

/// How long a start may wait for what others know, for all inputs together.
const ASK_ALL: Duration = Duration::from_secs(6);
/// How often it is looked whether definitions have come.
const ASK_EVERY: Duration = Duration::from_millis(20);
/// How often a refusal is said again, with how many there were: what a lambda can cause in a loop
/// must not fill a log.
const SAY_EVERY: Duration = Duration::from_secs(10);

/// The transport's end of a ring. The lock is only ever taken by the transport's own thread.
struct Ingest {
    end: Mutex<End>,
    arrivals: Arc<Arrivals>,
    input: String,
    /// After remapping.
    topic: String,
    /// By kind. Each loss is counted in the ring's status, too.
    refused: [Mutex<Refused>; 2],
    bell: Option<Bell>,
}

struct End {
    ring: RingWriter<SampleMeta>,
    /// What was copied last, until it is known whose sample it is.
    copied: Option<Result<Draft<SampleMeta>, Refusal>>,
}

#[derive(Default)]
struct Refused {
    unsaid: u64,
    said: Option<Instant>,
}

impl Sink for Ingest {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        let verdict = self.fill(cdr);
        self.accept(meta);
        verdict
    }

    fn too_big(&self, _: &SampleMeta, len: usize) {
        // A ring refuses such a length by itself, and counts it.
        let refused = self.end().ring.draft(len).err();
        self.arrivals.refuse();
        if let Some(refusal) = refused {
            self.say(refusal);
        }
    }

    fn copy(&self, cdr: &[u8]) -> Option<Verdict> {
        Some(self.fill(cdr))
    }

    fn accept(&self, meta: &SampleMeta) {
        let mut end = self.end();
        match end.copied.take() {
            Some(Ok(draft)) => {
                self.arrivals.add(meta, &draft);
                let published = end.ring.publish(draft, *meta);
                drop(end);
                published.map(drop).expect("the draft is this ring's own");
                if let Some(bell) = &self.bell {
                    bell.thread.unpark();
                }
            }
            Some(Err(refusal)) => {
                drop(end);
                self.arrivals.refuse();
                self.say(refusal);
            }
            None => {}
        }
    }
}

impl Ingest {
    fn end(&self) -> MutexGuard<'_, End> {
        self.end.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The one copy.
    fn fill(&self, cdr: &[u8]) -> Verdict {
        let mut end = self.end();
        // First, so that the slot of one that was never accepted is free again.
        end.copied = None;
        let drafted = end.ring.draft(cdr.len()).map(|mut draft| {
            draft.copy_from_slice(cdr);
            draft
        });
        let verdict = match drafted {
            Ok(_) => Verdict::Taken,
            Err(Refusal::NoSlot) => Verdict::NoSlot,
            Err(Refusal::TooBig { .. }) => Verdict::TooBig,
        };
        end.copied = Some(drafted);
        verdict
    }

    fn say(&self, refusal: Refusal) {
        let refused = match refusal {
            Refusal::NoSlot => &self.refused[0],
            Refusal::TooBig { .. } => &self.refused[1],
        };
        let Some(samples) = refused.lock().unwrap_or_else(PoisonError::into_inner).due() else {
            return;
        };
        match refusal {
            Refusal::NoSlot => {
                warn!(input = %self.input, topic = %self.topic, samples, "samples dropped: the lambda holds all slots");
            }
            Refusal::TooBig { len, max } => {
                let topic = &self.topic;
                warn!(input = %self.input, %topic, samples, bytes = len, max_size = max, "samples dropped: larger than max_size");
            }
        }
    }
}

impl Refused {
    /// One more; how many are to be said now, if it is time.
    fn due(&mut self) -> Option<u64> {
        self.unsaid += 1;
        if self.said.is_some_and(|said| said.elapsed() < SAY_EVERY) {
            return None;
        }
        self.said = Some(Instant::now());
        Some(std::mem::take(&mut self.unsaid))
    }
}

#[cfg(test)]
mod tests {
    use gleaner_buffers::{HeapRegion, RingReader};
    use gleaner_messages::Endian;
    use gleaner_transport::Guid;

    use super::*;

    fn ingest() -> (Ingest, RingReader<SampleMeta>) {
        let (slots, slot_bytes) = (3, 8);
        let region =
            HeapRegion::zeroed(Pool::<SampleMeta>::bytes_needed(slots, slot_bytes).unwrap())
                .unwrap();
        let (ring, reader) = ring(Pool::new(region, slots, slot_bytes).unwrap(), 2).unwrap();
        let (end, arrivals) = (Mutex::new(End { ring, copied: None }), Arc::new(Arrivals::new(2)));
        let (input, topic) = ("camera".to_owned(), "/camera".to_owned());
        (Ingest { end, arrivals, input, topic, refused: Default::default(), bell: None }, reader)
    }

    fn meta(seq: u64) -> SampleMeta {
        let (at_ns, writer) = (seq as i64, Guid::default());
        SampleMeta { at_ns, publish_ns: 0, writer, seq, endian: Endian::Little, options: [0; 2] }
    }

    #[test]
    fn what_is_copied_is_seen_once_it_is_accepted() {
        let (ingest, reader) = ingest();
        assert_eq!(ingest.copy(b"first"), Some(Verdict::Taken));
        assert!(reader.newest().is_none());
        ingest.accept(&meta(1));
        let newest = reader.newest().unwrap();
        assert_eq!((&*newest, newest.meta().seq), (b"first".as_slice(), 1));
        ingest.accept(&meta(2));
        assert_eq!(reader.counts().received, 1, "there was nothing to accept");
    }

    #[test]
    fn copies_that_are_never_accepted_leave_nothing_behind() {
        let (ingest, reader) = ingest();
        for _ in 0..10 {
            assert_eq!(ingest.copy(b"nobody's"), Some(Verdict::Taken));
        }
        assert_eq!(ingest.copy(b"mine"), Some(Verdict::Taken));
        ingest.accept(&meta(1));
        assert_eq!(&*reader.newest().unwrap(), b"mine");
        let counts = reader.counts();
        assert_eq!(
            (counts.received, counts.overwritten, counts.no_slot, counts.too_big),
            (1, 0, 0, 0)
        );
    }

    #[test]
    fn a_sample_that_is_told_of_as_too_big_counts_as_one_that_was_shown() {
        let (ingest, reader) = ingest();
        ingest.too_big(&meta(1), 9);
        assert!(reader.newest().is_none());
        assert_eq!(reader.counts().too_big, 1);
    }

    #[test]
    fn a_copy_that_is_refused_is_counted_and_not_taken_for_the_one_before() {
        let (ingest, reader) = ingest();
        assert_eq!(ingest.copy(b"old"), Some(Verdict::Taken));
        assert_eq!(ingest.copy(b"too large"), Some(Verdict::TooBig));
        ingest.accept(&meta(1));
        assert!(reader.newest().is_none());
        assert_eq!(ingest.deliver(&meta(2), b"new"), Verdict::Taken);
        assert_eq!((reader.counts().too_big, reader.newest().unwrap().meta().seq), (1, 2));
    }
}
