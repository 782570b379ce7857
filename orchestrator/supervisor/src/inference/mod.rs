//! Supervises `gleaner-inference`, the process that runs the models of all lambdas of a run or of a
//! replay.
//!
//! - `service`: starts the process, connects lambdas to it, and starts it again after it has ended.
//! - `process`: one process. `blame`: the models that ended it several times.
//! - `trial`: the first load of a model, in a process of its own.
//! - `client`: the connection of a lambda, which outlives the process.
//! - `passed_model`: a model as it is passed to the process, with its engine in the store.
//! - `totals`: the counts of the models over all processes.

mod blame;
mod client;
mod passed_model;
mod process;
mod service;
mod totals;
mod trial;

use std::path::Path;
use std::time::Duration;

use gleaner_protocol::inference::InferenceReport;

pub use service::InferenceService;

/// Program and name of the process.
const INFERENCE: &str = "gleaner-inference";

#[derive(Debug, Clone, Copy)]
pub enum InferenceUse<'a> {
    /// The models of several lambdas, live: none may harm another one.
    Shared,
    OneLambda,
    /// It builds engines into this folder.
    Engines(&'a Path),
}

/// Events of the process, for the user.
pub enum InferenceEvent {
    Report(InferenceReport),
    /// A piece of its standard error.
    Stderr(Vec<u8>),
    /// It has ended without a request, for this reason, and is started again after the delay. True
    /// for a fault of its own, false if it was killed, stood still or could not be started.
    Ended(String, Duration, bool),
    /// A model is refused for the rest of the run, for this reason.
    Refused(String),
    /// Something else went wrong.
    Warning(String),
}
