//! Costs of isolation: the same lambda as a native function, as a component with and without
//! checks, and in Python, over the same recorded input.
//!
//! - `sides`: the ways to run it; `native` is the function. `wakes`: time and CPU per wake.
//! - `access`: host calls, columns and frames; `hosted` runs them in a component.
//! - `live`: processes of `gleaner run`, their memory, and a kill. `faults`: what a fault costs.

mod access;
mod drives;
mod faults;
mod hosted;
mod live;
mod native;
mod sides;
mod wakes;

use gleaner_bench::BenchResults;

pub use sides::{BenchGuest, run_as_runtime};

/// Measures all costs; the sides take turns in an order by `seed`.
pub(super) fn measure(quick: bool, seed: u64, results: &mut BenchResults) {
    wakes::measure(quick, seed, results);
    access::measure(quick, seed, results);
    live::measure(quick, results);
    faults::measure(quick, results);
    results.notes.extend([
        format!(
            "*Time per wake* is `run_ns` of the decision, in a replay; the sides take turns, in an \
             order by the seed {seed}, and each is started again for its turn. All reach the same \
             decisions."
        ),
        "*Native function* has the same arithmetic, and calls the host's functions directly: without \
         a component, its memory, fuel, epochs and handles. It has the same rings, replay and \
         decisions around it."
            .to_owned(),
        "*Wasm* is the product, with fuel and epochs; the others have the same host around a \
         component that was compiled with fewer checks. No deadline applies in a replay."
            .to_owned(),
        "*CPU per wake of a replay* is that of all of its processes, with reading the drive and \
         writing the decisions, without their start. A replay in Python has two processes, which \
         both read the drive. That of a live run is the process of the lambda alone, which sleeps \
         between wakes."
            .to_owned(),
    ]);
}
