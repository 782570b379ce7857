//! Guests, which run lambdas. One thread owns a guest; nothing outside this room depends on its
//! kind.
//!
//! A guest that faults is never entered again: the next wake runs a fresh one, after its `init`.

#[cfg(feature = "wasm")]
pub mod wasm;

#[cfg(feature = "python")]
pub mod python;

mod meter;
pub mod sandboxed;
pub mod worker;

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::Failure;
use gleaner_lambda::Fault;
use gleaner_lambda::signals::Curve;
use gleaner_protocol::Layer;
use gleaner_vitals::usage;

use crate::api::curves::Curves;
use crate::api::data::{Counts, Topic, Wake};

/// Returns whether a call that returned after `elapsed` is a fault, though it was not interrupted
/// after `allowed`. All time counts, also that of other processes.
pub fn is_late(elapsed: Duration, allowed: Duration) -> bool {
    /// Delay with which an interruption may take effect.
    const TOLERANCE: Duration = Duration::from_millis(2);
    elapsed > allowed.saturating_add(TOLERANCE)
}

/// A lambda that can be woken.
pub trait Guest {
    /// Runs untrusted start-up code (site packages, numpy) before `init`. Called once, before the
    /// first `init`, or by that.
    ///
    /// # Errors
    ///
    /// The fault that ended it.
    fn prepare(&mut self) -> Result<(), Fault> {
        Ok(())
    }

    /// Runs `init`. Called once before the first wake; after a fault the guest repeats it itself.
    ///
    /// # Errors
    ///
    /// The fault that ended `init`.
    fn init(&mut self) -> Result<(), Fault>;

    /// Returns whether the lambda runs at `wake`: in another process, the ring may have had no slot
    /// for the sample that causes it.
    fn expects(&mut self, _wake: &Wake) -> bool {
        true
    }

    /// Runs one wake to its end.
    fn wake(&mut self, wake: Wake) -> WakeOutcome;

    /// Discards the lambda after a wake without a fault of its own: the next wake begins with a
    /// fresh one, as after a fault.
    fn discard(&mut self) {}

    /// The engine that runs the lambda, with its version: a decision is only reproducible on the
    /// same engine.
    fn engine(&self) -> String;

    /// The layers around the process that runs the lambda. Called before the first `init`.
    ///
    /// # Errors
    ///
    /// A failure if that process cannot be sandboxed.
    fn layers(&self) -> Result<Vec<Layer>, Failure> {
        Ok(Vec::new())
    }

    /// Resident memory of that process, in bytes.
    fn resident_bytes(&self) -> u64 {
        usage::resident()
    }

    /// Peak resident memory of that process, in bytes.
    fn most_resident_bytes(&self) -> u64 {
        usage::peak_resident()
    }

    /// Ends a lambda that runs in another process, after its last wake; returns the totals that
    /// only that process has.
    ///
    /// # Errors
    ///
    /// The fault with which that process ended.
    fn finish(&mut self) -> Result<Option<Totals>, Fault> {
        Ok(None)
    }
}

/// Totals of a replay, beside its decisions.
pub struct Totals {
    /// Counts of the samples of each input, in the manifest's order.
    pub counts: Vec<Counts>,
    /// Time spent decoding images, in ns.
    pub decode_ns: u64,
    /// Curves of the values that the lambda read.
    pub curves: Vec<Curve>,
    /// Number of fields that it read and that have no curve.
    pub curves_omitted: u64,
}

impl Totals {
    /// Totals of a lambda over `inputs` in this process, with the curves of what it read.
    pub fn of(inputs: &[Arc<Topic>], curves: &Curves) -> Self {
        let (curves, curves_omitted) = curves.take();
        Self {
            counts: inputs.iter().map(|topic| topic.counts()).collect(),
            decode_ns: inputs.iter().map(|topic| topic.decode_ns()).sum(),
            curves,
            curves_omitted,
        }
    }
}

/// Outcome of a wake.
pub struct WakeOutcome {
    /// The fault that ended it, if any.
    pub result: Result<(), Fault>,
    /// Fuel used, where the kind counts it and it is the same on every machine.
    pub fuel: Option<u64>,
    /// Time in the lambda, if another process measured it.
    pub run_ns: Option<u64>,
}
