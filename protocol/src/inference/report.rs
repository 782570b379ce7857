//! Reports of `gleaner-inference` to its starter: lines of JSON on its standard output.

use std::fs::File;
use std::os::unix::fs::FileExt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A report.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "inference", rename_all = "snake_case")]
pub enum InferenceReport {
    /// It runs, and opens its libraries.
    Starting,
    /// It accepts lambdas.
    Ready,
    /// It is about to load a model, and requests a trial in another process first.
    Try(TryLoad),
    /// A model was loaded, or could not be.
    Model(LoadedModel),
    /// Its status; sent each second in which something changed, and every 5 s.
    Status(InferenceStatus),
    /// Its final status.
    Ended(InferenceStatus),
}

/// A load: the digest and the options of a model.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TryLoad {
    /// SHA-256 of the file.
    pub sha256: String,
    /// Execution providers in order of preference; empty for any.
    pub providers: Vec<String>,
    /// Threads of one run.
    pub threads: u32,
}

/// A model that is loaded once for all lambdas that name it with the same options.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LoadedModel {
    /// SHA-256 of the file.
    pub sha256: String,
    /// Its path in the build of a lambda.
    pub path: String,
    /// Execution providers in order of preference; empty for any.
    pub providers: Vec<String>,
    /// Threads of one run.
    pub threads: u32,
    /// Names of the lambdas that may use it.
    pub lambdas: Vec<String>,
    /// Its state.
    pub state: ModelState,
    /// Backend, version, provider and threads; empty until it is loaded.
    pub runtime: String,
    /// The reason for this backend and provider, with the errors of those that were tried before.
    pub reason: String,
    /// Name of the runtime for which an engine was built, if the process was started to build some.
    pub built_for: Option<String>,
    /// Time to load it and to run it once, in ns.
    pub load_ns: u64,
    /// Number of runs.
    pub runs: u64,
    /// Number of requests that were answered with the result of an equal one.
    pub shared: u64,
    /// Number of requests that failed.
    pub failed: u64,
    /// Time of all runs, in ns.
    pub run_ns: u64,
    /// Memory that it takes.
    #[serde(default)]
    pub memory: ModelMemory,
}

/// Memory that a model took in a process without others, in bytes; zeros if that is unknown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ModelMemory {
    /// After its load and first run.
    pub held: u64,
    /// The largest amount until then.
    pub peak: u64,
}

/// State of a model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ModelState {
    /// It is being checked, loaded and run for the first time.
    #[default]
    Warming,
    /// It can run.
    Ready,
    /// It cannot be used.
    Failed,
}

/// The status of the process.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct InferenceStatus {
    /// All models.
    pub models: Vec<LoadedModel>,
    /// Number of connected lambdas.
    pub clients: u64,
    /// Number of requests that wait.
    pub waiting: u64,
    /// Memory of the process, in bytes.
    pub resident_bytes: u64,
}

/// Threads that run models: one for those within their demand, the others for those that may have
/// exceeded it at a time, none of which may make others wait.
pub const MODEL_WORKERS: usize = 16;

/// Length of a note of a model in use: the digits of its SHA-256, and, while it runs, a space and
/// the identity of the lambda; then a line break if others had left it too little memory. The first
/// note is that of the load; one for each thread follows.
pub const NOTE_BYTES: usize = 160;

/// Reads the notes of a process that has ended.
pub fn models_in_use(file: &File) -> Vec<String> {
    let mut notes = [0; (1 + MODEL_WORKERS) * NOTE_BYTES];
    let read = file.read_at(&mut notes, 0).unwrap_or(0);
    let notes = notes[..read].chunks(NOTE_BYTES).map(String::from_utf8_lossy);
    let notes = notes.map(|note| note.trim_end_matches('\0').to_owned());
    notes.filter(|note| !note.is_empty()).collect()
}
