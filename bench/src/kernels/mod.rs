//! Measures arithmetic in lambdas: kernels of the SDK in a component against the same source
//! natively, with registers of the same width, and the overhead of fuel, epochs and canonical NaNs.
//!
//! In each round every kernel runs natively and on every engine, one after the other; ratios are
//! computed within the round.

mod bare;
mod checks;

use bench_kernels::Work;

use crate::measure::timed;
use bare::{BareComponent, BareInstance};
pub use checks::EngineChecks;
use gleaner_bench::Figure;

/// Kernels, with the goal for the ratio of component to native time.
const KERNELS: [(&str, Option<f64>); 9] = [
    ("spectrum-256-f32", Some(1.5)),
    ("spectrum-1024-f32", Some(1.5)),
    ("spectrum-256-f64", Some(1.5)),
    ("spectrum-1024-f64", Some(1.5)),
    ("luma", Some(1.3)),
    ("gray", None),
    ("histogram", None),
    ("downscale", None),
    ("mean", None),
];

/// Engine settings. Overheads are relative to the first; that of NaNs is relative to the fourth,
/// the settings of the runtime.
const ENGINES: [EngineChecks; 5] = [
    EngineChecks::NONE,
    EngineChecks::FUEL,
    EngineChecks::EPOCHS,
    EngineChecks::DEFAULT,
    EngineChecks::NANS,
];

/// Approximate duration of one measurement in seconds.
const MEASURED_S: f64 = 0.005;

/// Measures everything; `quick` runs a single round.
pub fn figures(quick: bool) -> Vec<Figure> {
    let rounds = if quick { 1 } else { 31 };
    let mut figures = Vec::new();
    let components = ENGINES.map(BareComponent::compile);
    for (kernel, goal) in KERNELS {
        let guests = components
            .iter()
            .map(|component| BareInstance::new(component, kernel))
            .collect::<Vec<_>>();
        figures.extend(compare(kernel, goal, guests, rounds));
    }
    figures
}

/// Measures one kernel natively and on every engine.
fn compare(
    kernel: &str,
    goal: Option<f64>,
    mut guests: Vec<BareInstance>,
    rounds: usize,
) -> Vec<Figure> {
    let mut native = Work::new(kernel).expect("the bench and the lambda have the same kernels");
    let times = times_for(|times| drop(native.rounds(times)));
    let mut native_us = Vec::new();
    let mut guest_us = vec![Vec::new(); guests.len()];
    for _ in 0..rounds {
        let (us, expected) = timed(times, || native.rounds(times).expect("a kernel that works"));
        native_us.push(us);
        for (guest, measured) in guests.iter_mut().zip(&mut guest_us) {
            let (us, result) = timed(times, || guest.rounds(times));
            let off = (result - expected).abs() / expected.abs();
            assert!(off < 1e-5, "{kernel}: {result} in a component, {expected} natively");
            measured.push(us);
        }
    }
    let [none, fuel, epochs, default, nans] = guest_us.as_slice() else {
        unreachable!("a series for each engine")
    };
    let ratio = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a / b).collect::<Vec<_>>();
    let overhead =
        |a, b| ratio(a, b).into_iter().map(|ratio| 100.0 * (ratio - 1.0)).collect::<Vec<_>>();
    let figure = |what: &str, unit, values: &[f64]| {
        Figure::without_goal(&format!("{kernel}: {what}"), unit, values)
    };
    let against = ratio(default, &native_us);
    let name = format!("{kernel}: component, with fuel and epochs, against native");
    vec![
        figure("native", "us", &native_us),
        figure("component, with fuel and epochs", "us", default),
        match goal {
            Some(goal) => Figure::at_most(&name, "times", goal, &against),
            None => Figure::without_goal(&name, "times", &against),
        },
        figure("overhead of fuel", "%", &overhead(fuel, none)),
        figure("overhead of epochs", "%", &overhead(epochs, none)),
        figure("overhead of both", "%", &overhead(default, none)),
        figure("additional overhead of canonical NaNs", "%", &overhead(nans, default)),
    ]
}

/// Repetitions of `work` that take about [`MEASURED_S`].
fn times_for(mut work: impl FnMut(u64)) -> u64 {
    let mut times = 1;
    loop {
        let seconds = timed(1, || work(times)).0 / 1e6;
        if seconds > MEASURED_S / 2.0 {
            return ((times as f64 * MEASURED_S / seconds) as u64).max(1);
        }
        times *= 2;
    }
}
