//! The inputs of a lambda: each is a ring of the newest samples of a topic.
//!
//! In a replay this process fills the rings (`filled`): all their memory is mapped and touched
//! before the first sample, and a delivery copies the sample once and never waits for a lambda. In
//! a live run the ingress fills them in shared memory (`fed`), and this process reads them in
//! place.

mod owned_input;
mod shared_input;

use std::io;
use std::sync::Arc;

use gleaner_base::{Exit, Explain};
use gleaner_buffers::{Pool, PoolError};
use gleaner_lambda::manifest::{InputSpec, Manifest};
use gleaner_messages::Definitions;
use gleaner_messages::transport::TransportError;
use gleaner_samples::FeedError;

use crate::api::data::{InputRing, PerCall, Topic};
use crate::api::frame::{Budget, Images};
use crate::memory::Mapping;

pub use owned_input::open_inputs;
pub(crate) use shared_input::continue_fed_input;
pub use shared_input::open_fed_inputs;

#[derive(Debug, thiserror::Error)]
pub enum InputError {
    #[error("cannot lay out the memory of input `{input}`")]
    Layout { input: String, source: PoolError },
    #[error("cannot reserve {bytes} bytes of memory for input `{input}`")]
    Memory { input: String, bytes: usize, source: io::Error },
    #[error("cannot subscribe input `{input}`")]
    Subscribe { input: String, source: TransportError },
    #[error("cannot receive input `{input}`")]
    Receive { input: String, source: FeedError },
}

impl Explain for InputError {
    fn help(&self) -> Option<String> {
        let source = match self {
            Self::Layout { .. } | Self::Memory { .. } => {
                return Some("lower depth, hold or max_size of this [[input]]".to_owned());
            }
            Self::Receive { source, .. } => return source.help(),
            Self::Subscribe { source, .. } => source,
        };
        Some(match source {
            TransportError::NoSuchTopic { .. } => {
                "correct `topic` in lambda.toml, or pass --remap FROM:=TO".to_owned()
            }
            TransportError::WrongType { found, .. } => {
                format!("write type = \"{found}\" in lambda.toml, or choose another topic")
            }
            TransportError::Encoding { what: "schema encoding", .. } => {
                "put the .msg files of the type, and of those it refers to, into DIR/msg, and \
                 build again"
                    .to_owned()
            }
            _ => return None,
        })
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Subscribe { .. } => Exit::Usage,
            Self::Receive { source, .. } => source.exit(),
            Self::Layout { .. } | Self::Memory { .. } => Exit::Internal,
        }
    }
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

struct SharedLimits {
    budget: Budget,
    per_call: PerCall,
}

impl SharedLimits {
    fn of(manifest: &Manifest) -> Self {
        let limits = &manifest.limits;
        let frames = usize::try_from(limits.frames).unwrap_or(usize::MAX);
        Self {
            budget: Budget::new(frames, limits.memory.as_usize()),
            per_call: PerCall::new(limits),
        }
    }

    /// Returns the topic of an input, with memory for its decoded images.
    fn topic(
        &self,
        input: &InputSpec,
        ring: InputRing,
        definitions: Option<Arc<Definitions>>,
    ) -> Result<Arc<Topic>, InputError> {
        let decoded = match input.decoded_size {
            Some(bytes) => Some(pool(input, input.decoded_slots(), bytes.as_usize())?),
            None => None,
        };
        let images = (Images::new(decoded, self.budget.clone()), self.per_call.clone());
        let (name, topic) = (input.name.as_str(), input.topic.as_str());
        Ok(Topic::new(name, topic, input.type_name.as_str(), ring, definitions, images))
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

fn warn_of_missing_definitions(input: &InputSpec, type_name: &str) {
    let input = &input.name;
    tracing::warn!(%input, r#type = %type_name, "no message definitions: fields cannot be read");
}
