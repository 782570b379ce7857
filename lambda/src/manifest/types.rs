use std::time::Duration;

use serde::{Deserialize, Serialize, Serializer};

use super::{
    ByteSize, ConfigItem, ItemName, LambdaName, Limits, RelativePath, Sha256, TopicName, TypeName,
    Version,
};

/// What `lambda.toml` says, checked. As JSON it has the file's keys; durations are `_ns`, sizes are
/// in bytes.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Manifest {
    /// `[lambda]`: what it is.
    pub lambda: Lambda,
    /// `[schedule]`: when it runs.
    pub schedule: Schedule,
    /// `[[input]]`, in the order of the file. Names and topics are unique; an event schedule names
    /// one of them.
    #[serde(rename = "input")]
    pub inputs: Vec<Input>,
    /// `[[model]]`, in the order of the file, with unique names.
    #[serde(rename = "model")]
    pub models: Vec<Model>,
    /// `[record]`: the clip that an event trigger opens; `None` if the lambda records nothing.
    pub record: Option<Record>,
    /// `[limits]`: what it may use.
    pub limits: Limits,
    /// `[config]`, in the order of the file.
    pub config: Vec<ConfigItem>,
}

/// `[lambda]`: what it is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Lambda {
    /// Its name, unique in a fleet.
    pub name: LambdaName,
    /// Its version.
    pub version: Version,
    /// The language it is hosted as.
    pub kind: Kind,
    /// What is loaded, relative to the build folder: a component, or the Python file with the
    /// lambda.
    pub entry: RelativePath,
    /// One line for people.
    pub description: Option<String>,
    /// Of a component: whether every NaN that it computes has the same bits on every CPU.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub deterministic: bool,
}

/// The kinds of lambda.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A WebAssembly component.
    Wasm,
    /// A Python file.
    Python,
}

impl Kind {
    /// The word of the file: `wasm` or `python`.
    pub fn as_str(self) -> &'static str {
        match self {
            Kind::Wasm => "wasm",
            Kind::Python => "python",
        }
    }
}

/// `[schedule]`: when a lambda runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Schedule {
    /// On samples of one input.
    Event {
        /// The name of that input.
        #[serde(rename = "event")]
        input: ItemName,
        /// What happens to samples that arrive during a wake.
        backlog: Backlog,
    },
    /// On the clock.
    Periodic {
        /// Time between ticks.
        #[serde(rename = "period_ns", serialize_with = "nanoseconds")]
        period: Duration,
    },
}

/// What happens to event samples that arrive while the lambda runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Backlog {
    /// Each wakes the lambda once, in order, as far as the ring reaches.
    Each,
    /// The newest wakes it, the others are counted as skipped.
    Latest,
}

/// `[[input]]`: one topic that the lambda sees.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Input {
    /// The lambda's word for it.
    pub name: ItemName,
    /// The topic, before remapping.
    pub topic: TopicName,
    /// The message type.
    #[serde(rename = "type")]
    pub type_name: TypeName,
    /// How many samples the ring shows.
    pub depth: usize,
    /// Largest sample that is accepted, as CDR.
    pub max_size: ByteSize,
    /// Largest image after decoding to rgb8; only compressed images have it.
    pub decoded_size: Option<ByteSize>,
    /// How many samples the lambda may hold on to beyond those that the ring shows.
    pub hold: usize,
    /// How the topic is subscribed.
    pub qos: Qos,
}

impl Input {
    /// How many slots the samples of this input need: those in the ring, those held, and the one
    /// being written.
    pub fn slots(&self) -> usize {
        self.depth + self.hold + 1
    }

    /// How many slots decoded images need: those held, and the one being decoded.
    pub fn decoded_slots(&self) -> usize {
        self.hold + 1
    }

    /// Memory that this input takes before the first sample: its slots, and those of decoded
    /// images.
    pub fn memory(&self) -> ByteSize {
        let decoded = self.decoded_size.map_or(0, ByteSize::bytes);
        let samples = (self.slots() as u64).saturating_mul(self.max_size.bytes());
        ByteSize::new(samples.saturating_add((self.decoded_slots() as u64).saturating_mul(decoded)))
    }
}

/// How a topic is subscribed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Qos {
    /// Adapts to what the publishers offer.
    Auto,
    /// Exactly this. Keys that the table leaves out have the values of ROS 2's default profile.
    #[serde(untagged)]
    Fixed {
        /// Whether lost samples are sent again.
        reliability: Reliability,
        /// Whether late subscribers get earlier samples.
        durability: Durability,
        /// The history that DDS keeps.
        depth: usize,
    },
}

/// Whether lost samples are sent again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    /// They are.
    Reliable,
    /// They are not.
    BestEffort,
}

/// Whether a late subscriber gets samples from before it came.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// It does not.
    Volatile,
    /// It gets those that the publisher still has.
    TransientLocal,
}

/// `[[model]]`: a file with a neural network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Model {
    /// The lambda's word for it.
    pub name: ItemName,
    /// The file, relative to the build folder.
    pub file: RelativePath,
    /// What the file must hash to.
    pub sha256: Sha256,
    /// How its outputs are laid out, for example `yolov8`; `None` leaves them as tensors.
    pub layout: Option<String>,
    /// Execution providers in the order in which they are tried; empty leaves the choice to the
    /// vehicle.
    pub providers: Vec<String>,
    /// Threads that one run may use; `None` leaves the choice to the vehicle.
    pub threads: Option<usize>,
}

/// `[record]`: the clip that an event trigger opens.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Record {
    /// What the clip holds: at least one topic, each once; they need not be inputs.
    pub topics: Vec<TopicName>,
    /// How far the clip reaches back from the anchor.
    #[serde(rename = "preroll_ns", serialize_with = "nanoseconds")]
    pub preroll: Duration,
    /// How far the clip reaches beyond the anchor.
    #[serde(rename = "postroll_ns", serialize_with = "nanoseconds")]
    pub postroll: Duration,
    /// Where the preroll waits.
    pub store: Store,
    /// The most that waits there; beyond it the oldest goes, and is counted.
    pub preroll_size: ByteSize,
    /// How long after a trigger the next ones open no new window.
    #[serde(rename = "cooldown_ns", serialize_with = "nanoseconds")]
    pub cooldown: Duration,
    /// The longest clip; what is longer goes on in a next one.
    #[serde(rename = "max_length_ns", serialize_with = "nanoseconds")]
    pub max_length: Duration,
}

/// Where the preroll waits for a trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Store {
    /// In bounded memory.
    Ram,
    /// In rolling chunks on disk, with a cap on their bytes: for heavy topics.
    Disk,
}

impl Manifest {
    /// The input of this name.
    pub fn input(&self, name: &str) -> Option<&Input> {
        self.inputs.iter().find(|input| input.name == name)
    }

    /// The input whose samples wake the lambda; `None` if the clock does.
    pub fn event_input(&self) -> Option<&Input> {
        match &self.schedule {
            Schedule::Event { input, .. } => self.input(input.as_str()),
            Schedule::Periodic { .. } => None,
        }
    }

    /// The manifest as JSON, with the keys of the file and every default filled in.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::to_value(self).expect("a manifest has only text keys and finite numbers")
    }
}

/// No duration in a manifest exceeds an hour, so that its nanoseconds fit.
fn nanoseconds<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u64(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX))
}
