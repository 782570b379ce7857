//! Guests, which run the code of lambdas: as WebAssembly or Python, in this process or in another.
//! Callers use the trait [`Guest`] and do not depend on the kind. One thread owns a guest.
//!
//! After a fault, a guest discards its instance of the lambda. The next wake creates a new one and
//! runs its `init` first.

#[cfg(feature = "wasm")]
pub mod wasm;

#[cfg(feature = "python")]
pub mod python;

mod meter;
pub mod sandboxed;
pub mod worker;

use std::fmt;
use std::sync::Arc;

use gleaner_base::Failure;
use gleaner_lambda::Fault;
use gleaner_lambda::signals::Curve;
use gleaner_protocol::Layer;
use gleaner_protocol::process_stats::usage;
use serde::{Deserialize, Serialize};

use crate::api::curves::Curves;
use crate::api::data::{Counts, Topic, Wake};

/// The engine of a lambda, on which alone its decisions are reproducible. Its text has all parts,
/// with a semicolon between them.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct LambdaEngine {
    /// The engine, with its version.
    pub name: String,
    /// The runtime of each model.
    pub models: Vec<String>,
}

impl fmt::Display for LambdaEngine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)?;
        self.models.iter().try_for_each(|model| write!(f, "; {model}"))
    }
}

/// A lambda that can be woken.
pub trait Guest {
    /// Runs untrusted start-up code (site packages, numpy) before `init`. Called at most once; if
    /// it was not, the first `init` calls it. Returns the fault that ended the start-up code.
    fn prepare(&mut self) -> Result<(), Fault> {
        Ok(())
    }

    /// Runs `init`. Called once before the first wake; after a fault the guest repeats it itself.
    /// Returns the fault that ended it.
    fn init(&mut self) -> Result<(), Fault>;

    /// Returns whether the lambda runs in this wake. A guest in another process skips a wake if the
    /// ring of that process had no slot for the sample.
    fn expects(&mut self, _wake: &Wake) -> bool {
        true
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome;

    /// Discards the instance of the lambda, as after a fault. Called if a call returned without a
    /// fault but the lambda uses too much memory, and instead of a wake that cannot be repeated.
    fn discard(&mut self) {}

    /// Returns what runs the lambda, and its models so far.
    fn engine(&self) -> LambdaEngine;

    /// The sandbox layers of the process that runs the lambda. Called before the first `init`.
    /// Fails if that process cannot be sandboxed.
    fn layers(&self) -> Result<Vec<Layer>, Failure> {
        Ok(Vec::new())
    }

    /// Resident memory of the process that runs the lambda, in bytes.
    fn resident_bytes(&self) -> u64 {
        usage::resident()
    }

    /// Peak resident memory of the process that runs the lambda, in bytes.
    fn peak_resident_bytes(&self) -> u64 {
        usage::peak_resident()
    }

    /// Ends a lambda that runs in another process, after its last wake. Returns the totals, which
    /// only that process has; `None` for a lambda in this process; or the fault with which that
    /// process ended.
    fn finish(&mut self) -> Result<Option<Totals>, Fault> {
        Ok(None)
    }
}

/// Totals of a replay that its decisions do not contain.
pub struct Totals {
    /// Counts of the samples of each input, in the manifest's order.
    pub counts: Vec<Counts>,
    /// Time spent decoding images, in ns.
    pub decode_ns: u64,
    pub curves: Vec<Curve>,
    /// Number of fields that the lambda read beyond the maximum number of curves.
    pub curves_omitted: u64,
}

impl Totals {
    /// Totals of a lambda in this process: of its `inputs`, and the curves of the values it read.
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

pub struct WakeOutcome {
    pub result: Result<(), Fault>,
    /// Fuel used. `None` for Python, which has none, and where it depends on the machine.
    pub fuel: Option<u64>,
    /// Run time of the lambda, if it runs in another process, which measures it.
    pub run_ns: Option<u64>,
    /// Run time of models, if they were run for another process.
    pub model_ns: Option<u64>,
}

impl WakeOutcome {
    #[allow(dead_code, reason = "without a kind of lambda, there are no wakes")]
    pub(crate) fn faulted(fault: Fault) -> Self {
        Self { result: Err(fault), fuel: None, run_ns: None, model_ns: None }
    }
}
