//! The rings that hold samples: one for each input of the manifest, filled by the transport's
//! thread.
//!
//! All memory is mapped and touched here, before the first sample. A delivery copies the sample
//! once and never waits for a lambda.

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

use gleaner_buffers::{Draft, DraftError, Pool, PoolError, RingWriter, ring};
use gleaner_lambda::manifest::{self, Durability, InputSpec, Manifest, Reliability};
use gleaner_transport::{
    ArrivalSums, Delivery, Qos, SampleMeta, Sink, StoredMeta, TopicSpec, Transport, TransportError,
};

use tracing::warn;

use crate::api::data::{InputRing, PerCall, Topic};
use crate::api::frame::{Budget, Images};
use crate::api::trace::SumsBefore;
use crate::memory::Mapping;

/// An input that could not be set up.
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

/// The thread to unpark when an input receives a sample.
#[derive(Clone, Debug)]
pub struct InputWaker {
    /// The input.
    pub input: String,
    /// The waiting thread.
    pub thread: Thread,
}

/// Settings of inputs whose samples arrive while the lambda runs.
#[derive(Clone, Debug)]
pub struct LiveInputs {
    /// The thread to unpark when the event input receives a sample; `None` for a periodic schedule.
    pub waker: Option<InputWaker>,
}

/// Samples up to this size are small: their ring has spare slots for as many samples as it shows.
const SMALL_BYTES: u64 = 64 << 10;
/// Spare slots for large samples: as many may arrive during a wake before one that it sees leaves.
const SPARE_LARGE: usize = 2;

/// Number of slots beyond the depth that the lambda sees, so that visible samples do not leave the
/// ring during a wake.
fn spare(input: &InputSpec) -> usize {
    if input.max_size.bytes() <= SMALL_BYTES { input.depth } else { input.depth.min(SPARE_LARGE) }
}

/// Upper bound of the bytes that a live process needs beside its rings: decisions that wait to be
/// written, and partial messages of the network.
pub fn unfinished_bytes(manifest: &Manifest) -> u64 {
    const LINES: u64 = 48 << 20;
    // RustDDS keeps up to 128 partial messages per writer, and ends the process if an allocation
    // fails.
    const MESSAGES: u64 = 130;
    let sizes = manifest.inputs.iter().map(|input| input.max_size.bytes().saturating_mul(MESSAGES));
    sizes.fold(LINES, u64::saturating_add)
}

/// Number of slots of an input in a live run. One of them is for the newest sample that a wake
/// sees, which is pinned while the wake runs.
pub fn live_slots(input: &InputSpec) -> usize {
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
    live: Option<&LiveInputs>,
) -> Result<Vec<Arc<Topic>>, InputError> {
    let limits = &manifest.limits;
    let frames = usize::try_from(limits.frames).unwrap_or(usize::MAX);
    let shared = SharedLimits {
        budget: Budget::new(frames, limits.memory.as_usize()),
        per_call: PerCall::new(limits),
        query_until: Instant::now() + QUERY_TIMEOUT,
    };
    manifest
        .inputs
        .iter()
        .map(|input| open_input(input, remaps, transport, live, &shared))
        .collect()
}

/// Limits that all inputs of a lambda share.
struct SharedLimits {
    /// Deadline of type queries to other nodes.
    query_until: Instant,
    budget: Budget,
    per_call: PerCall,
}

fn open_input(
    input: &InputSpec,
    remaps: &[Remap],
    transport: &mut dyn Transport,
    live: Option<&LiveInputs>,
    shared: &SharedLimits,
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
    let images = (Images::new(decoded, shared.budget.clone()), shared.per_call.clone());
    let sums_digests = Arc::<AtomicBool>::default();
    let ingest = Arc::new(Ingest {
        fill: Mutex::new(RingFill { ring: writer, copied: None, sums: ArrivalSums::default() }),
        sums_digests: sums_digests.clone(),
        input: input.name.to_string(),
        topic: spec.topic.clone(),
        refusals: Default::default(),
        waker: live
            .and_then(|live| live.waker.clone())
            .filter(|waker| waker.input == input.name.as_str()),
    });
    transport.subscribe(&spec, ingest).map_err(subscribe)?;
    // A node that writes the topic can describe its type, where no local definition does.
    let found = loop {
        match transport.definitions(&spec.topic) {
            Err(TransportError::NoDefinitions { .. })
                if Instant::now() < shared.query_until
                    && transport.definitions_may_come(&spec.topic) =>
            {
                std::thread::sleep(QUERY_POLL);
            }
            found => break found,
        }
    };
    let definitions = match found {
        Ok(definitions) => Some(definitions),
        Err(TransportError::NoDefinitions { type_name, .. }) => {
            let input = &input.name;
            warn!(%input, r#type = %type_name, "no message definitions: fields cannot be read");
            None
        }
        Err(error) => return Err(subscribe(error)),
    };
    Ok(Topic::new(
        input.name.as_str(),
        topic,
        &spec.type_name,
        InputRing { reader, depth: input.depth, sums_digests, sums_before: SumsBefore::default() },
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
    input: &InputSpec,
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

/// Time that a start may wait for definitions from other nodes, for all inputs together.
const QUERY_TIMEOUT: Duration = Duration::from_secs(6);
/// Interval at which arrived definitions are checked for.
const QUERY_POLL: Duration = Duration::from_millis(20);
/// Interval at which refused samples are logged, with their number: what a lambda can cause in a
/// loop must not fill a log.
const LOG_INTERVAL: Duration = Duration::from_secs(10);

/// The transport's end of a ring. Only the transport's own thread takes the lock.
struct Ingest {
    fill: Mutex<RingFill>,
    sums_digests: Arc<AtomicBool>,
    input: String,
    /// Name of the topic after remapping.
    topic: String,
    /// One for each kind of refusal. The ring's status counts each loss, too.
    refusals: [Mutex<RefusalLog>; 2],
    waker: Option<InputWaker>,
}

struct RingFill {
    ring: RingWriter<StoredMeta>,
    /// The last copy, until its sample is accepted.
    copied: Option<Result<Draft<StoredMeta>, DraftError>>,
    sums: ArrivalSums,
}

#[derive(Default)]
struct RefusalLog {
    /// Refusals since the last log line.
    unlogged: u64,
    logged: Option<Instant>,
}

impl Sink for Ingest {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        let verdict = self.copy_in(cdr);
        self.accept(meta);
        verdict
    }

    fn too_big(&self, _: &SampleMeta, len: usize) {
        // The ring refuses such a length, and counts it.
        let mut fill = self.fill();
        let refused = fill.ring.draft(len).err();
        fill.sums.refuse();
        drop(fill);
        if let Some(refusal) = refused {
            self.log(refusal);
        }
    }

    fn copy(&self, cdr: &[u8]) -> Option<Delivery> {
        Some(self.copy_in(cdr))
    }

    fn accept(&self, meta: &SampleMeta) {
        let mut fill = self.fill();
        match fill.copied.take() {
            Some(Ok(draft)) => {
                if self.sums_digests.load(Ordering::Relaxed) {
                    fill.sums.enable_digests();
                }
                let stored = fill.sums.add(meta, &draft);
                let published = fill.ring.publish(draft, stored);
                drop(fill);
                published.map(drop).expect("the draft is this ring's own");
                if let Some(waker) = &self.waker {
                    waker.thread.unpark();
                }
            }
            Some(Err(refusal)) => {
                fill.sums.refuse();
                drop(fill);
                self.log(refusal);
            }
            None => {}
        }
    }
}

impl Ingest {
    fn fill(&self) -> MutexGuard<'_, RingFill> {
        self.fill.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Copies a sample into a slot of the ring; the only copy of it.
    fn copy_in(&self, cdr: &[u8]) -> Delivery {
        let mut fill = self.fill();
        // First, so that the slot of a copy that was never accepted is free again.
        fill.copied = None;
        let drafted = fill.ring.draft(cdr.len()).map(|mut draft| {
            draft.copy_from_slice(cdr);
            draft
        });
        let verdict = match drafted {
            Ok(_) => Delivery::Taken,
            Err(DraftError::NoSlot) => Delivery::NoSlot,
            Err(DraftError::TooBig { .. }) => Delivery::TooBig,
        };
        fill.copied = Some(drafted);
        verdict
    }

    fn log(&self, refusal: DraftError) {
        let refusals = match refusal {
            DraftError::NoSlot => &self.refusals[0],
            DraftError::TooBig { .. } => &self.refusals[1],
        };
        let Some(samples) = refusals.lock().unwrap_or_else(PoisonError::into_inner).due() else {
            return;
        };
        let (input, topic) = (&self.input, &self.topic);
        match refusal {
            DraftError::NoSlot => {
                warn!(%input, %topic, samples, "samples dropped: the lambda holds all slots");
            }
            DraftError::TooBig { len, max } => {
                let (bytes, max_size) = (len, max);
                warn!(
                    %input,
                    %topic,
                    samples,
                    bytes,
                    max_size,
                    "samples dropped: larger than max_size"
                );
            }
        }
    }
}

impl RefusalLog {
    /// Counts a refusal; returns the number to log, if a log line is due.
    fn due(&mut self) -> Option<u64> {
        self.unlogged += 1;
        if self.logged.is_some_and(|logged| logged.elapsed() < LOG_INTERVAL) {
            return None;
        }
        self.logged = Some(Instant::now());
        Some(std::mem::take(&mut self.unlogged))
    }
}

#[cfg(test)]
mod tests {
    use gleaner_buffers::{HeapRegion, RingReader};
    use gleaner_messages::Endian;
    use gleaner_transport::Guid;

    use super::*;

    fn ingest() -> (Ingest, RingReader<StoredMeta>) {
        let (slots, slot_bytes) = (3, 8);
        let region =
            HeapRegion::zeroed(Pool::<StoredMeta>::bytes_needed(slots, slot_bytes).unwrap())
                .unwrap();
        let (ring, reader) = ring(Pool::new(region, slots, slot_bytes).unwrap(), 2).unwrap();
        let fill = RingFill { ring, copied: None, sums: ArrivalSums::default() };
        let ingest = Ingest {
            fill: Mutex::new(fill),
            sums_digests: Arc::default(),
            input: "camera".to_owned(),
            topic: "/camera".to_owned(),
            refusals: Default::default(),
            waker: None,
        };
        (ingest, reader)
    }

    fn meta(seq: u64) -> SampleMeta {
        let (at_ns, writer) = (seq as i64, Guid::default());
        SampleMeta { at_ns, publish_ns: 0, writer, seq, endian: Endian::Little, options: [0; 2] }
    }

    #[test]
    fn a_copy_is_visible_once_it_is_accepted() {
        let (ingest, reader) = ingest();
        assert_eq!(ingest.copy(b"first"), Some(Delivery::Taken));
        assert!(reader.newest().is_none());
        ingest.accept(&meta(1));
        let newest = reader.newest().unwrap();
        assert_eq!((&*newest, newest.meta().sample.seq), (b"first".as_slice(), 1));
        ingest.accept(&meta(2));
        assert_eq!(reader.counts().received, 1, "nothing was copied before this call");
    }

    #[test]
    fn copies_that_are_never_accepted_take_no_slot() {
        let (ingest, reader) = ingest();
        for _ in 0..10 {
            assert_eq!(ingest.copy(b"dropped"), Some(Delivery::Taken));
        }
        assert_eq!(ingest.copy(b"kept"), Some(Delivery::Taken));
        ingest.accept(&meta(1));
        assert_eq!(&*reader.newest().unwrap(), b"kept");
        let counts = reader.counts();
        assert_eq!(
            (counts.received, counts.overwritten, counts.no_slot, counts.too_big),
            (1, 0, 0, 0)
        );
    }

    #[test]
    fn a_sample_reported_as_too_big_is_counted_like_a_delivered_one() {
        let (ingest, reader) = ingest();
        ingest.too_big(&meta(1), 9);
        assert!(reader.newest().is_none());
        assert_eq!(reader.counts().too_big, 1);
    }

    #[test]
    fn a_refused_copy_is_counted_and_does_not_publish_the_previous_one() {
        let (ingest, reader) = ingest();
        assert_eq!(ingest.copy(b"old"), Some(Delivery::Taken));
        assert_eq!(ingest.copy(b"too large"), Some(Delivery::TooBig));
        ingest.accept(&meta(1));
        assert!(reader.newest().is_none());
        assert_eq!(ingest.deliver(&meta(2), b"new"), Delivery::Taken);
        assert_eq!((reader.counts().too_big, reader.newest().unwrap().meta().sample.seq), (1, 2));
    }
}
