//! Inputs whose rings a source fills in this process, in a replay or a check.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use gleaner_buffers::{Draft, DraftError, RingWriter, ring};
use gleaner_lambda::manifest::{self, Durability, InputSpec, Manifest, Reliability};
use gleaner_messages::transport::{
    ArrivalSums, Delivery, Qos, SampleMeta, Sink, StoredMeta, TopicSpec, Transport, TransportError,
};
use tracing::warn;

use super::{InputError, Remap, SharedLimits, pool, warn_of_missing_definitions};
use crate::api::data::{InputRing, SumsBefore, Topic};

/// Subscribes every input of `manifest` and returns its topics, in the manifest's order.
pub fn open_inputs(
    manifest: &Manifest,
    remaps: &[Remap],
    transport: &mut dyn Transport,
) -> Result<Vec<Arc<Topic>>, InputError> {
    let shared = SharedLimits::of(manifest);
    manifest.inputs.iter().map(|input| open_input(input, remaps, transport, &shared)).collect()
}

fn open_input(
    input: &InputSpec,
    remaps: &[Remap],
    transport: &mut dyn Transport,
    shared: &SharedLimits,
) -> Result<Arc<Topic>, InputError> {
    let layout = |source| InputError::Layout { input: input.name.to_string(), source };
    let subscribe = |source| InputError::Subscribe { input: input.name.to_string(), source };
    let spec = TopicSpec {
        topic: Remap::apply(remaps, input.topic.as_str()).to_owned(),
        type_name: input.type_name.to_string(),
        queue: input.depth,
        max_bytes: input.max_size.as_usize(),
        qos: qos(input.qos),
    };
    let samples = pool(input, input.slots(), spec.max_bytes)?;
    let (writer, reader) = ring(samples, input.depth).map_err(layout)?;
    let sums_digests = Arc::<AtomicBool>::default();
    let ingest = Arc::new(Ingest {
        fill: Mutex::new(RingFill { ring: writer, copied: None, sums: ArrivalSums::default() }),
        sums_digests: sums_digests.clone(),
        slots: (input.slots(), spec.max_bytes),
        largest: AtomicUsize::default(),
        input: input.name.to_string(),
        topic: spec.topic.clone(),
        refusals: Default::default(),
    });
    transport.subscribe(&spec, ingest).map_err(subscribe)?;
    let definitions = match transport.definitions(&spec.topic) {
        Ok(definitions) => Some(definitions),
        Err(TransportError::NoDefinitions { type_name, .. }) => {
            warn_of_missing_definitions(input, &type_name);
            None
        }
        Err(error) => return Err(subscribe(error)),
    };
    let (depth, sums_before) = (input.depth, SumsBefore::default());
    let ring = InputRing { reader, depth, sums_digests, sums_before };
    shared.topic(input, ring, definitions)
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

/// Interval at which refused samples are logged, with their number: what a lambda can cause in a
/// loop must not fill a log.
const LOG_INTERVAL: Duration = Duration::from_secs(10);

/// The transport's end of a ring. Only the transport's own thread takes the lock.
struct Ingest {
    fill: Mutex<RingFill>,
    sums_digests: Arc<AtomicBool>,
    /// Number of slots of the ring, and bytes of each.
    slots: (usize, usize),
    /// Bytes of the largest sample.
    largest: AtomicUsize,
    input: String,
    /// Name of the topic after remapping.
    topic: String,
    /// One for each kind of refusal. The ring's status counts each loss, too.
    refusals: [Mutex<RefusalLog>; 2],
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
        self.largest.fetch_max(cdr.len(), Ordering::Relaxed);
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

impl Drop for Ingest {
    /// Warns of a ring of 32 MiB or more if each sample left 15 of 16 bytes of its slot unused.
    fn drop(&mut self) {
        let (Self { input, topic, .. }, (slots, max_size)) = (&*self, self.slots);
        let largest = self.largest.load(Ordering::Relaxed);
        let ring_mib = slots.saturating_mul(max_size) >> 20;
        if (1..max_size / 16).contains(&largest) && ring_mib >= 32 {
            warn!(
                %input, %topic, largest, max_size, ring_mib,
                "max_size is large for the samples; `gleaner inspect` prints one that fits"
            );
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
    use gleaner_buffers::{HeapRegion, Pool, RingReader};
    use gleaner_messages::transport::Guid;

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
            slots: (slots, slot_bytes),
            largest: AtomicUsize::default(),
            input: "camera".to_owned(),
            topic: "/camera".to_owned(),
            refusals: Default::default(),
        };
        (ingest, reader)
    }

    fn meta(seq: u64) -> SampleMeta {
        SampleMeta::new(seq as i64, Guid::default(), seq)
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
