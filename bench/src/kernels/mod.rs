//! Measures arithmetic in lambdas: kernels of the SDK in a component against the same source
//! natively, with registers of the same width, and the overhead of fuel, epochs and canonical NaNs.
//! Also measures calls between lambda and host.
//!
//! In each round every kernel runs natively and on every engine, one after the other; ratios are
//! computed within the round.

mod bare;
mod hosted;

use std::hint::black_box;

use bench_kernels::Work;
use rustix::time::{ClockId, clock_gettime};

use bare::{BareInstance, EngineChecks};
use gleaner_bench_results::Figure;
use hosted::HostedKernel;

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

/// Engine settings. Overheads are relative to `NONE`; that of NaNs is relative to `DEFAULT`, the
/// settings of the runtime.
const NONE: EngineChecks = EngineChecks { fuel: false, epochs: false, nans: false };
const FUEL: EngineChecks = EngineChecks { fuel: true, ..NONE };
const EPOCHS: EngineChecks = EngineChecks { epochs: true, ..NONE };
const DEFAULT: EngineChecks = EngineChecks { fuel: true, epochs: true, nans: false };
const NANS: EngineChecks = EngineChecks { nans: true, ..DEFAULT };
const ENGINES: [EngineChecks; 5] = [NONE, FUEL, EPOCHS, DEFAULT, NANS];

/// Approximate duration of one measurement in seconds.
const MEASURED_S: f64 = 0.005;

/// Measures everything; `quick` runs a single round.
pub fn figures(quick: bool) -> Vec<Figure> {
    let rounds = if quick { 1 } else { 31 };
    let mut figures = Vec::new();
    let components = ENGINES.map(bare::compile);
    for (kernel, goal) in KERNELS {
        let guests = components
            .iter()
            .map(|component| BareInstance::new(component, kernel))
            .collect::<Vec<_>>();
        figures.extend(compare(kernel, goal, guests, rounds));
    }
    figures.extend(host_calls(rounds));
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

/// Measures calls between lambda and host, as in a replay.
fn host_calls(rounds: usize) -> Vec<Figure> {
    let (mut empty, mut call) = (HostedKernel::new("copy", 0), HostedKernel::new("call", 100_000));
    let (mut stream, mut copy) = (HostedKernel::new("stream", 4), HostedKernel::new("copy", 4));
    let source = vec![7_u8; hosted::FRAME_BYTES];
    let mut target = vec![0_u8; hosted::FRAME_BYTES];
    let mut series: [Vec<f64>; 7] = Default::default();
    for _ in 0..rounds {
        let tick_ns = 1000.0 * timed(2000, || (0..2000).for_each(|_| empty.tick())).0;
        let call_ns = 1000.0 * timed(call.rounds(), || call.frame()).0;
        let stream_us = timed(stream.rounds(), || stream.frame()).0;
        let copy_us = timed(copy.rounds(), || copy.frame()).0;
        let copied = || {
            (0..copy.rounds())
                .for_each(|_| black_box(&mut target).copy_from_slice(black_box(&source)))
        };
        let memcpy_us = timed(copy.rounds(), copied).0;
        let row = [
            tick_ns,
            call_ns,
            stream_us,
            copy_us,
            memcpy_us,
            stream_us / memcpy_us,
            copy_us / memcpy_us,
        ];
        series.iter_mut().zip(row).for_each(|(series, value)| series.push(value));
    }
    vec![
        Figure::without_goal("wake of an empty lambda", "ns", &series[0]),
        Figure::without_goal("host call `now-ns`", "ns", &series[1]),
        Figure::without_goal(
            "1920x1080 bgr8 (6.2 MB) read by a lambda in pieces of 64 KiB",
            "us",
            &series[2],
        ),
        Figure::without_goal("the same, pieces copied into a whole frame", "us", &series[3]),
        Figure::without_goal("the same by memcpy", "us", &series[4]),
        Figure::at_most("1920x1080 bgr8 read in pieces, against memcpy", "times", 1.1, &series[5]),
        Figure::without_goal(
            "1920x1080 bgr8 read in pieces into a whole frame, against memcpy",
            "times",
            &series[6],
        ),
    ]
}

/// Microseconds for each of the `times` repetitions of `work`, and its result. Measured in CPU time
/// of this thread: other work on the core matters only by its effect on the caches.
fn timed<T>(times: u64, work: impl FnOnce() -> T) -> (f64, T) {
    let now_us = || {
        let now = clock_gettime(ClockId::ThreadCPUTime);
        now.tv_sec as f64 * 1e6 + now.tv_nsec as f64 / 1e3
    };
    let started_us = now_us();
    let result = work();
    ((now_us() - started_us) / times as f64, result)
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
