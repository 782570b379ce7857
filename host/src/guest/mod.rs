//! Where lambdas run. One thread owns a guest; nothing outside this room knows which kind it is.
//!
//! A guest that faults is never entered again: the next wake finds a fresh one, after its `init`.

#[cfg(feature = "wasm")]
pub mod wasm;

#[cfg(feature = "python")]
pub mod python;

mod meter;
pub mod watched;

use std::time::Duration;

use gleaner_protocol::Fault;

use crate::api::data::Wake;

/// Whether a call that came back by itself after `elapsed` is a fault, though nothing ended it when `allowed` was over. All time counts,
/// also that in which the machine did something else.
pub fn is_late(elapsed: Duration, allowed: Duration) -> bool {
    /// What would have ended it comes about so late.
    const TOLERANCE: Duration = Duration::from_millis(2);
    elapsed > allowed.saturating_add(TOLERANCE)
}

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

    /// Gives up the lambda after a wake that was good in itself, as after a fault: the next wake begins with a fresh one.
    fn discard(&mut self) {}

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
