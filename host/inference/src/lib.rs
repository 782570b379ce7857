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
//! A lambda is an untrusted peer, and so is the author of a model: no byte of either is trusted. A
//! lambda that breaks the protocol loses its connection; a model that takes too much memory or time
//! ends the process, which its starter starts again.

#[cfg(feature = "program")]
pub mod backend;
#[cfg(feature = "program")]
mod client;
#[cfg(feature = "program")]
mod engine;
#[cfg(feature = "program")]
mod engine_error;
pub mod inspect;
#[cfg(feature = "program")]
mod lambdas;
#[cfg(feature = "program")]
mod loader;
#[cfg(feature = "program")]
mod loads;
#[cfg(feature = "program")]
mod memory;
#[cfg(feature = "program")]
mod pace;
pub mod places;
#[cfg(feature = "program")]
pub mod program;
pub mod queue;
#[cfg(feature = "program")]
mod region;
#[cfg(feature = "program")]
mod running;
#[cfg(feature = "program")]
mod schedule;
#[cfg(feature = "program")]
mod sessions;
#[cfg(feature = "program")]
mod threads;
#[cfg(feature = "program")]
mod worker;
