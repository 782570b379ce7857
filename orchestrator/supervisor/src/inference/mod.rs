//! Supervises `gleaner-inference`, the process that runs the models of all lambdas of a run or of a
//! replay.
//!
//! - `service`: starts the process, connects lambdas to it, and starts it again after it has ended.
//! - `process`: one process. `blame`: the models that ended it several times.
//! - `trial`: the first load of a model, in a process of its own.
//! - `client`: the connection of a lambda, which outlives the process.
//! - `passed_model`: a model as it is passed to the process. `engine`: its engine in the store.
//! - `totals`: the counts of the models over all processes.
//! - `event`: what happens to the process, for the user.

mod blame;
mod client;
mod engine;
mod event;
mod passed_model;
mod process;
mod service;
mod totals;
mod trial;

pub use event::InferenceEvent;
pub use service::InferenceService;

/// Program and name of the process.
const INFERENCE: &str = "gleaner-inference";

#[derive(Debug, Clone, Copy)]
pub enum InferenceUse<'a> {
    /// The models of several lambdas, live: none may harm another one.
    Shared,
    OneLambda,
    /// It builds engines into this folder.
    Engines(&'a std::path::Path),
}
