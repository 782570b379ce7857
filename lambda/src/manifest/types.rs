//! The content of a validated manifest.

use std::time::Duration;

use serde::{Deserialize, Serialize, Serializer};

use super::{
    ByteSize, ConfigItem, ItemName, LambdaName, Limits, RelativePath, Sha256, TopicName, TypeName,
    Version,
};

/// The validated content of `lambda.toml`. As JSON it has the file's keys; durations are `_ns`,
/// sizes are in bytes.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Manifest {
    /// `[lambda]`: identity and code.
    pub lambda: LambdaSection,
    /// `[schedule]`: the times at which it runs.
    pub schedule: ScheduleSpec,
    /// `[[input]]`, in the order of the file. Names and topics are unique; an event schedule names
    /// one of them.
    #[serde(rename = "input")]
    pub inputs: Vec<InputSpec>,
    /// `[[model]]`, in the order of the file, with unique names.
    #[serde(rename = "model")]
    pub models: Vec<ModelSpec>,
    /// `[record]`: the clip that an event trigger opens; `None` if the lambda records nothing.
    pub record: Option<RecordSpec>,
    /// `[limits]`: the resources that it may use.
    pub limits: Limits,
    /// `[demand]`: the resources that it needs, by which a vehicle admits it.
    #[serde(skip_serializing_if = "Demand::is_empty")]
    pub demand: Demand,
    /// `[config]`, in the order of the file.
    pub config: Vec<ConfigItem>,
}

/// `[lambda]`: identity and code.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct LambdaSection {
    /// Name, unique in a fleet.
    pub name: LambdaName,
    /// Version.
    pub version: Version,
    /// Kind of code: a WebAssembly component, or Python.
    pub kind: LambdaKind,
    /// File to load, relative to the build folder: the component, or the Python file.
    pub entry: RelativePath,
    /// Data files and folders of a Python lambda, relative to its folder. The build has them under
    /// the same paths.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub files: Vec<RelativePath>,
    /// One-line description.
    pub description: Option<String>,
    /// True to give every NaN of a component the same bits on every CPU, at a cost in speed.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub deterministic: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LambdaKind {
    /// A WebAssembly component.
    #[default]
    Wasm,
    /// A Python file.
    Python,
}

impl LambdaKind {
    /// Returns the word in manifests: `wasm` or `python`.
    pub fn as_str(self) -> &'static str {
        match self {
            LambdaKind::Wasm => "wasm",
            LambdaKind::Python => "python",
        }
    }
}

/// `[schedule]`: the times at which a lambda runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum ScheduleSpec {
    /// On samples of one input.
    Event {
        /// Input whose samples wake the lambda.
        #[serde(rename = "event")]
        input: ItemName,
        /// Handling of samples that arrive during a wake.
        backlog: Backlog,
    },
    /// On the clock.
    Periodic {
        /// Time between ticks.
        #[serde(rename = "period_ns", serialize_with = "nanoseconds")]
        period: Duration,
    },
}

/// The treatment of event samples that arrive while the lambda runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Backlog {
    /// Each sample wakes the lambda once, in order, as far back as the ring reaches.
    Each,
    /// Only the newest sample wakes it; the others are counted as skipped.
    Latest,
}

/// `[[input]]`: a topic that the lambda reads.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct InputSpec {
    /// Name by which the code looks up the input.
    pub name: ItemName,
    /// Topic name, before remapping.
    pub topic: TopicName,
    /// Message type.
    #[serde(rename = "type")]
    pub type_name: TypeName,
    /// Number of newest samples that the lambda can read.
    pub depth: usize,
    /// Largest accepted sample, as CDR.
    pub max_size: ByteSize,
    /// Largest image after decoding to rgb8; compressed images only.
    pub decoded_size: Option<ByteSize>,
    /// Number of samples that the lambda may keep beyond those of `depth`.
    pub hold: usize,
    /// Quality of service of the subscription.
    pub qos: Qos,
}

impl InputSpec {
    /// Returns the number of slots for samples: those in the ring, those held, and the one being
    /// written.
    pub fn slots(&self) -> usize {
        self.depth + self.hold + 1
    }

    /// Returns the number of slots for decoded images: those held, and the one being decoded.
    pub fn decoded_slots(&self) -> usize {
        self.hold + 1
    }

    /// Returns the memory that is allocated before the first sample: for samples and decoded
    /// images.
    pub fn memory(&self) -> ByteSize {
        let decoded = self.decoded_size.map_or(0, ByteSize::bytes);
        let samples = (self.slots() as u64).saturating_mul(self.max_size.bytes());
        ByteSize::new(samples.saturating_add((self.decoded_slots() as u64).saturating_mul(decoded)))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Qos {
    /// Adapts to what the publishers offer.
    Auto,
    /// Exactly this profile. Keys that the table leaves out have the values of ROS 2's default
    /// profile.
    #[serde(untagged)]
    Fixed {
        /// Retransmission of lost samples.
        reliability: Reliability,
        /// Delivery of earlier samples to late subscribers.
        durability: Durability,
        /// History depth of DDS.
        depth: usize,
    },
}

/// Retransmission of lost samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    /// Lost samples are sent again.
    Reliable,
    /// Lost samples are not sent again.
    BestEffort,
}

/// Delivery of earlier samples to late subscribers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// A late subscriber gets no earlier samples.
    Volatile,
    /// A late subscriber gets the samples that the publisher still has.
    TransientLocal,
}

/// `[[model]]`: a file with a neural network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct ModelSpec {
    /// Name by which the code looks up the model.
    pub name: ItemName,
    /// Model file, relative to the build folder.
    pub file: RelativePath,
    /// SHA-256 of the file.
    pub sha256: Sha256,
    /// Layout of a detector's input and outputs: `ultralytics`, `yolox`, `nms-free` or `nanodet`.
    /// Without it, the model has no `detect`.
    pub layout: Option<String>,
    /// Text file with the name of a class in each line, relative to the build folder.
    pub labels: Option<RelativePath>,
    /// Execution providers, in order of preference: `tensorrt`, `cuda`, `cpu`, or `onnxruntime` and
    /// `rten` for one that runs on the CPU. If empty, `cpu`.
    pub providers: Vec<String>,
    /// Threads that one run may use.
    pub threads: usize,
}

/// `[record]`: the clip that an event trigger opens.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct RecordSpec {
    /// Topics in the clip: at least one, each once; they need not be inputs.
    pub topics: Vec<TopicName>,
    /// Time before the anchor that the clip covers.
    #[serde(rename = "preroll_ns", serialize_with = "nanoseconds")]
    pub preroll: Duration,
    /// Time after the anchor that the clip covers.
    #[serde(rename = "postroll_ns", serialize_with = "nanoseconds")]
    pub postroll: Duration,
    /// Storage of the preroll.
    pub store: Store,
    /// Size of the preroll; beyond it, the oldest samples are evicted and counted.
    pub preroll_size: ByteSize,
    /// Time after a trigger during which further triggers open no window.
    #[serde(rename = "cooldown_ns", serialize_with = "nanoseconds")]
    pub cooldown: Duration,
    /// Longest clip; a longer recording continues in the next clip.
    #[serde(rename = "max_length_ns", serialize_with = "nanoseconds")]
    pub max_length: Duration,
}

/// Storage of the preroll.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Store {
    /// In bounded memory.
    Ram,
    /// In rolling chunks on disk, with a cap on their bytes: for heavy topics.
    Disk,
}

/// `[demand]`: the resources that a lambda needs in its busiest minute, as its author states.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Demand {
    /// Wakes per second; with `event` only, as a period states it.
    pub rate_hz: Option<f64>,
    /// CPU time of a wake, on this kind of vehicle.
    #[serde(rename = "cpu_ns", serialize_with = "optional_nanoseconds")]
    pub cpu: Option<Duration>,
    /// Fuel units of a wake, in place of `cpu`: a vehicle converts them by its measured speed.
    /// Components only.
    pub fuel: Option<u64>,
    /// Time that the models of a wake run, on this kind of vehicle.
    #[serde(rename = "model_time_ns", serialize_with = "optional_nanoseconds")]
    pub model_time: Option<Duration>,
}

impl Demand {
    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

impl Manifest {
    pub fn input(&self, name: &str) -> Option<&InputSpec> {
        self.inputs.iter().find(|input| input.name == name)
    }

    /// Returns the input whose samples wake the lambda; `None` for a periodic one.
    pub fn event_input(&self) -> Option<&InputSpec> {
        match &self.schedule {
            ScheduleSpec::Event { input, .. } => self.input(input.as_str()),
            ScheduleSpec::Periodic { .. } => None,
        }
    }

    /// Returns the manifest as JSON, with the keys of the file and every default filled in.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::to_value(self).expect("a manifest has only text keys and finite numbers")
    }
}

/// Serializes a duration as nanoseconds. No duration in a manifest exceeds an hour, so they fit.
fn nanoseconds<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u64(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX))
}

fn optional_nanoseconds<S: Serializer>(
    duration: &Option<Duration>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    match duration {
        Some(duration) => nanoseconds(duration, serializer),
        None => serializer.serialize_none(),
    }
}
