//! Supervises `gleaner-inference`, the process that runs the models of all lambdas of a run or of a
//! replay.
//!
//! - `service`: starts the process, connects lambdas to it, and starts it again after it has ended.
//! - `client`: the connection of a lambda, which outlives the process.
//! - `engine`: the engine of a model in the store.
//! - `totals`: the counts of the models over all processes.
//! - `event`: what happens to the process, for the user.

mod client;
mod engine;
mod event;
mod service;
mod totals;

pub use event::InferenceEvent;
pub use service::InferenceService;

/// Program and name of the process.
const INFERENCE: &str = "gleaner-inference";
