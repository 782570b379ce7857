//! What a lambda's own arithmetic costs: kernels of the SDK in a component against the same source
//! natively, on registers of the same width; and what fuel, epochs and the canonicalisation of NaNs
//! add to it. Then what passes between lambda and host.
//!
//! In each round every kernel runs natively and on every engine, one after the other, and is
//! compared within the round.

mod bare;
mod hosted;

use std::hint::black_box;

use bench_kernels::Work;
use rustix::time::{ClockId, clock_gettime};

use crate::measure::Figure;
use bare::{Bare, Checks};
use hosted::Hosted;

/// Kernels, with what a run in a component may take at most against a native one.
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

/// What code is made to check, and what is told of it against code that checks nothing or, for
/// NaNs, as much as ours.
const NONE: Checks = Checks { fuel: false, epochs: false, nans: false };
const FUEL: Checks = Checks { fuel: true, ..NONE };
const EPOCHS: Checks = Checks { epochs: true, ..NONE };
const OURS: Checks = Checks { fuel: true, epochs: true, nans: false };
const NANS: Checks = Checks { nans: true, ..OURS };
const ENGINES: [Checks; 5] = [NONE, FUEL, EPOCHS, OURS, NANS];

/// Seconds that a single measurement takes, about.
const MEASURED_S: f64 = 0.005;

/// Measures everything; `quick` shows that it runs.
pub fn figures(quick: bool) -> Vec<Figure> {
    let rounds = if quick { 1 } else { 31 };
    let mut figures = Vec::new();
    let components = ENGINES.map(bare::compiled);
    for (kernel, goal) in KERNELS {
        let guests =
            components.iter().map(|component| Bare::new(component, kernel)).collect::<Vec<_>>();
        figures.extend(compare(kernel, goal, guests, rounds));
    }
    figures.extend(between(rounds));
    figures
}

/// One kernel natively and on every engine.
fn compare(kernel: &str, goal: Option<f64>, mut guests: Vec<Bare>, rounds: usize) -> Vec<Figure> {
    let mut native = Work::new(kernel).expect("the bench and the lambda know the same kernels");
    let times = times_for(|times| drop(native.rounds(times)));
    let mut native_us = Vec::new();
    let mut guest_us = vec![Vec::new(); guests.len()];
    for _ in 0..rounds {
        let (us, expected) = timed(times, || native.rounds(times).expect("a kernel that works"));
        native_us.push(us);
        for (guest, measured) in guests.iter_mut().zip(&mut guest_us) {
            let (us, made) = timed(times, || guest.rounds(times));
            let off = (made - expected).abs() / expected.abs();
            assert!(off < 1e-5, "{kernel}: {made} in a component, {expected} natively");
            measured.push(us);
        }
    }
    let [none, fuel, epochs, ours, nans] = guest_us.as_slice() else {
        unreachable!("a series for each engine")
    };
    let ratio = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a / b).collect::<Vec<_>>();
    let price =
        |a, b| ratio(a, b).into_iter().map(|ratio| 100.0 * (ratio - 1.0)).collect::<Vec<_>>();
    let told =
        |what: &str, unit, values: &[f64]| Figure::told(&format!("{kernel}: {what}"), unit, values);
    let against = ratio(ours, &native_us);
    let name = format!("{kernel}: component, with fuel and epochs, against native");
    vec![
        told("native", "us", &native_us),
        told("component, with fuel and epochs", "us", ours),
        match goal {
            Some(goal) => Figure::at_most(&name, "times", goal, &against),
            None => Figure::told(&name, "times", &against),
        },
        told("price of fuel", "%", &price(fuel, none)),
        told("price of epochs", "%", &price(epochs, none)),
        told("price of both", "%", &price(ours, none)),
        told("price of canonical NaNs on top", "%", &price(nans, ours)),
    ]
}

/// What passes between lambda and host, as in a replay.
fn between(rounds: usize) -> Vec<Figure> {
    let (mut empty, mut call) = (Hosted::new("copy", 0), Hosted::new("call", 100_000));
    let (mut stream, mut copy) = (Hosted::new("stream", 4), Hosted::new("copy", 4));
    let source = vec![7_u8; hosted::FRAME_BYTES];
    let mut place = vec![0_u8; hosted::FRAME_BYTES];
    let mut series: [Vec<f64>; 7] = Default::default();
    for _ in 0..rounds {
        let tick_ns = 1000.0 * timed(2000, || (0..2000).for_each(|_| empty.tick())).0;
        let call_ns = 1000.0 * timed(call.rounds(), || call.frame()).0;
        let stream_us = timed(stream.rounds(), || stream.frame()).0;
        let copy_us = timed(copy.rounds(), || copy.frame()).0;
        let copied = || {
            (0..copy.rounds())
                .for_each(|_| black_box(&mut place).copy_from_slice(black_box(&source)))
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
        Figure::told(
            "host calls a lambda that does nothing, with all that surrounds a wake",
            "ns",
            &series[0],
        ),
        Figure::told("lambda calls the host for the time", "ns", &series[1]),
        Figure::told("1920x1080 bgr8 (6.2 MB) to a lambda, in pieces of 64 KiB", "us", &series[2]),
        Figure::told("the same, each piece copied to its place in a whole frame", "us", &series[3]),
        Figure::told("the same by memcpy", "us", &series[4]),
        Figure::at_most(
            "1920x1080 bgr8 in pieces to a lambda, against memcpy",
            "times",
            1.1,
            &series[5],
        ),
        Figure::told(
            "1920x1080 bgr8 in pieces to a whole frame of a lambda, against memcpy",
            "times",
            &series[6],
        ),
    ]
}

/// Microseconds of each of `times` that `work` does, and what it says. It is time of this thread on
/// a core: what else runs there meanwhile is left out, but for what it does to the caches.
fn timed<T>(times: u64, work: impl FnOnce() -> T) -> (f64, T) {
    let now_us = || {
        let now = clock_gettime(ClockId::ThreadCPUTime);
        now.tv_sec as f64 * 1e6 + now.tv_nsec as f64 / 1e3
    };
    let started_us = now_us();
    let said = work();
    ((now_us() - started_us) / times as f64, said)
}

/// How often `work` has to be done to take [`MEASURED_S`].
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
