//! Where lambdas run. One thread owns a guest; nothing outside this room knows which kind it is.
//!
//! A guest that faults is never entered again: the next wake finds a fresh one, after its `init`.

#[cfg(feature = "wasm")]
pub mod wasm;

#[cfg(feature = "python")]
pub mod python;

mod meter;
pub mod watched;
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

/// Whether a call that came back by itself after `elapsed` is a fault, though nothing ended it when
/// `allowed` was over. All time counts, also that in which the machine did something else.
pub fn is_late(elapsed: Duration, allowed: Duration) -> bool {
    /// What would have ended it comes about so late.
    const TOLERANCE: Duration = Duration::from_millis(2);
    elapsed > allowed.saturating_add(TOLERANCE)
}

/// A lambda that can be woken.
pub trait Guest {
    /// Runs what comes before the lambda and is as foreign as it. Called once, before the first
    /// `init`, or by that.
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

    /// Whether the lambda runs at `wake`: in another process, the sample that is to wake it may
    /// have found no room.
    fn expects(&mut self, _wake: &Wake) -> bool {
        true
    }

    /// Runs one wake to its end.
    fn wake(&mut self, wake: Wake) -> Outcome;

    /// Gives up the lambda after a wake that was good in itself, as after a fault: the next wake
    /// begins with a fresh one.
    fn discard(&mut self) {}

    /// What runs the lambda, with its version: a decision is only the same again on the same.
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

    /// The most that it was.
    fn most_resident_bytes(&self) -> u64 {
        usage::most_resident()
    }

    /// Ends a lambda that runs in another process, after its last wake; returns what is known there
    /// alone.
    ///
    /// # Errors
    ///
    /// The fault with which that process ended instead.
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
    /// Values that the lambda read.
    pub curves: Vec<Curve>,
    /// Fields that it read and that have no curve.
    pub curves_omitted: u64,
}

impl Totals {
    /// Of a lambda over `inputs` in this process, with what it read of them.
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

/// How a wake ended.
pub struct Outcome {
    /// What went wrong, if anything did.
    pub result: Result<(), Fault>,
    /// Fuel used by this wake, where the kind counts it and it is the same on every machine.
    pub fuel: Option<u64>,
    /// Time in the lambda, if it was measured elsewhere.
    pub run_ns: Option<u64>,
}
