//! Where samples are held: one ring for each input of the manifest, filled from the transport's thread.
//!
//! All memory is taken and touched here, before the first sample. Delivering copies a sample once and never waits for a lambda.

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use gleaner_buffers::{Pool, PoolError, Refusal, RingWriter, ring};
use gleaner_protocol::manifest::{self, Durability, Input, Manifest, Reliability};
use gleaner_transport::{Qos, SampleMeta, Sink, TopicSpec, Transport, TransportError, Verdict};

use tracing::warn;

use crate::api::data::Topic;
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

/// Subscribes every input of `manifest` and returns its topics, in the manifest's order.
///
/// # Errors
///
/// [`InputError`] names the input.
pub fn open_inputs(
    manifest: &Manifest,
    remaps: &[Remap],
    transport: &mut dyn Transport,
) -> Result<Vec<Arc<Topic>>, InputError> {
    let made = Budget::new(manifest.limits.memory.as_usize());
    manifest.inputs.iter().map(|input| open_input(input, remaps, transport, &made)).collect()
}

fn open_input(
    input: &Input,
    remaps: &[Remap],
    transport: &mut dyn Transport,
    made: &Budget,
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

    let samples = pool(input, input.slots(), spec.max_bytes)?;
    let (writer, reader) = ring(samples, input.depth).map_err(layout)?;
    let decoded = match input.decoded_size {
        Some(bytes) => Some(pool(input, input.decoded_slots(), bytes.as_usize())?),
        None => None,
    };
    let images = Images::new(decoded, made.clone());
    let arrivals = Arc::<Arrivals>::default();
    let ingest = Arc::new(Ingest {
        ring: Mutex::new(writer),
        arrivals: arrivals.clone(),
        input: input.name.to_string(),
        said: Default::default(),
    });
    transport.subscribe(&spec, ingest).map_err(subscribe)?;
    let definitions = transport.definitions(&spec.topic).map_err(subscribe)?;
    Ok(Topic::new(input.name.as_str(), topic, &spec.type_name, reader, arrivals, definitions, images))
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
    let bytes = Pool::<M>::bytes_needed(slots, slot_bytes).ok_or(PoolError::TooLarge { slots, slot_bytes });
    let bytes = bytes.map_err(layout)?;
    let region = Mapping::populated(bytes).map_err(|source| InputError::Memory { input: name(), bytes, source })?;
    Pool::new(region, slots, slot_bytes).map_err(layout)
}

/// The transport's end of a ring. The lock is only ever taken by the transport's own thread.
struct Ingest {
    ring: Mutex<RingWriter<SampleMeta>>,
    arrivals: Arc<Arrivals>,
    input: String,
    /// Each loss is counted; each kind is said once, and what counts then is in the status.
    said: [AtomicBool; 2],
}

impl Sink for Ingest {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        let mut writer = self.ring.lock().unwrap_or_else(PoisonError::into_inner);
        match writer.draft(cdr.len()) {
            Ok(mut draft) => {
                draft.copy_from_slice(cdr);
                self.arrivals.add(meta, cdr);
                match writer.publish(draft, *meta) {
                    Ok(_) => Verdict::Taken,
                    Err(_) => unreachable!("the draft is this ring's own"),
                }
            }
            Err(refusal) => self.refuse(refusal),
        }
    }
}

impl Ingest {
    fn refuse(&self, refusal: Refusal) -> Verdict {
        let (verdict, said) = match refusal {
            Refusal::NoSlot => (Verdict::NoSlot, &self.said[0]),
            Refusal::TooBig { .. } => (Verdict::TooBig, &self.said[1]),
        };
        if !said.swap(true, Ordering::Relaxed) {
            match refusal {
                Refusal::NoSlot => warn!(input = %self.input, "sample dropped: the lambda holds all slots"),
                Refusal::TooBig { len, max } => {
                    warn!(input = %self.input, bytes = len, max_size = max, "sample dropped: larger than max_size");
                }
            }
        }
        verdict
    }
}
