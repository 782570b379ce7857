//! The process that runs the models of all lambdas on this machine.
//!
//! - `engine`, `engine_error`: the loop: owns the lambdas, the sessions and the order of runs;
//!   never waits.
//! - `client`, `lambdas`: a connected lambda, and all of them. `sessions`: models with their
//!   options, shared by lambdas.
//! - `schedule`, [`queue`], `pace`: the order of runs, which ones run beside others, their rate.
//!   `loads`: the order of loads, and their files. [`places`]: checks of requests.
//! - `threads`, `loader`, `worker`: the thread that checks and loads models, and those that run
//!   them. `running`: notes for the starter which model is in use, and the limits of time.
//! - `region`: memory that is shared with a lambda.
//! - [`inspect`]: checks of a model's file before a library parses it.
//! - [`backend`]: the libraries that run models.
//! - [`program`]: the program `gleaner-inference`.
//!
//! A lambda is a stranger, and so is the author of a model: no byte of either is trusted. A lambda
//! that breaks the protocol loses its connection; a model that takes too much memory or time ends
//! the process, which its starter starts again.

pub mod backend;
mod client;
mod engine;
mod engine_error;
pub mod inspect;
mod lambdas;
mod loader;
mod loads;
mod memory;
#[cfg(test)]
#[path = "../tests/suite/onnx.rs"]
mod onnx;
mod pace;
pub mod places;
pub mod program;
pub mod queue;
mod region;
mod running;
mod schedule;
mod sessions;
mod threads;
mod worker;
