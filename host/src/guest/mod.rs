//! Where lambdas run. One thread owns a guest; nothing outside this room knows which kind it is.
//!
//! A guest that faults is never entered again: the next wake finds a fresh one, after its `init`.

#[cfg(feature = "wasm")]
pub mod wasm;

#[cfg(feature = "python")]
pub mod python;

pub mod watched;

use gleaner_protocol::Fault;

use crate::api::data::Wake;

/// A lambda that can be woken.
pub trait Guest {
    /// Runs what comes before the lambda and is as foreign as it. Called once, before the first `init`, or by that.
    ///
    /// # Errors
    ///
    /// The fault that ended it.
    fn prepare(&mut self) -> Result<(), Fault> {
        Ok(())
    }

    /// Runs `init`. Called once before the first wake; a guest repeats it by itself after a fault.
    ///
    /// # Errors
    ///
    /// The fault that ended `init`.
    fn init(&mut self) -> Result<(), Fault>;

    /// Runs one wake to its end.
    fn wake(&mut self, wake: Wake) -> Outcome;

    /// What runs the lambda, with its version: a decision is only the same again on the same.
    fn engine(&self) -> String;
}

/// How a wake ended.
pub struct Outcome {
    /// What went wrong, if anything did.
    pub result: Result<(), Fault>,
    /// Fuel used by this wake, where the kind counts it and it is the same on every machine.
    pub fuel: Option<u64>,
}
