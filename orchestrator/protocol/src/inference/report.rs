//! Reports of `gleaner-inference` to its starter: lines of JSON on its standard output.

use serde::{Deserialize, Serialize};

/// A report.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "inference", rename_all = "snake_case")]
pub enum InferenceReport {
    /// It accepts lambdas.
    Ready,
    /// A model was loaded, or could not be.
    Model(LoadedModel),
    /// Its status; sent each second in which something changed.
    Status(InferenceStatus),
    /// Its final status.
    Ended(InferenceStatus),
}

/// A model that is loaded once for all lambdas that name it with the same options.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
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
}

/// State of a model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
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
