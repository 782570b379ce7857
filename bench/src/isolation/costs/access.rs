//! Cost of a host call, of a column, and of the ways to the pixels of a frame, in CPU time.
//!
//! Native calls are those of the functions behind the host calls, without a guest.

use std::collections::BTreeMap;
use std::hint::black_box;

use gleaner_bench::{BenchResults, Figure, Series, SeriesGroup};
use gleaner_test_support::random::XorShift64;
use gleaner_tests::{TempFolder, replay, root};

use super::drives::{self, FRAME_BYTES};
use super::hosted::{COLUMN, FilledInputs, HostedKernel};
use crate::measure::{shuffled, timed};

/// Name of the row of a copy without Gleaner.
const MEMCPY: &str = "memcpy";

/// Places of the measured times.
const NATIVE: usize = 0;
const WASM: usize = 1;
const PYTHON: usize = 2;

/// Measured times by the name of their row.
type Times = BTreeMap<&'static str, Vec<f64>>;

pub(super) fn measure(quick: bool, seed: u64, results: &mut BenchResults) {
    eprintln!("host calls, columns and frames");
    let (blocks, rounds) = if quick { (1, 1) } else { (5, 6) };
    let [native, wasm, python] = measured(blocks, rounds, &mut XorShift64(seed.max(1)));
    let of_kinds =
        |name| [("native", &native, name), ("wasm", &wasm, name), ("Python", &python, name)];
    results.groups.push(group("A host call, now-ns", ("ns", 1.0), "native", &of_kinds("call")));
    let name = "A field of 256 samples, as a column";
    results.groups.push(group(name, ("us", 1e3), "native", &of_kinds("column")));
    let frame = [
        (MEMCPY, &native, "memcpy"),
        ("native: mean luma by the host", &native, "luma-by-host"),
        ("wasm: mean luma by the host", &wasm, "luma-by-host"),
        ("Python: mean luma by the host", &python, "luma-by-host"),
        ("wasm: read in pieces of 64 KiB", &wasm, "stream"),
        ("wasm: pieces copied into a whole frame", &wasm, "copy"),
        ("wasm: copied, then mean luma in the lambda", &wasm, "copy-luma"),
        ("Python: view as an array", &python, "array"),
        ("Python: copy of that array", &python, "copy"),
        ("Python: mean of that array by numpy", &python, "mean"),
    ];
    let name = "A frame of 1080p bgr8 (6.2 MB)";
    results.groups.push(group(name, ("us", 1e3), MEMCPY, &frame));
    let ratios = wasm["stream"].iter().zip(&native["memcpy"]).map(|(read, copied)| read / copied);
    results.figures.push(Figure::at_most(
        "1920x1080 bgr8 read in pieces by a component, against memcpy",
        "times",
        1.1,
        &ratios.collect::<Vec<_>>(),
    ));
    let name = "slot to ndarray, 1920x1080 bgr8 (6.2 MB)";
    results.figures.push(Figure::at_most(name, "ns", 1000.0, &python["array"]));
    let name = "wake of an empty component, in a loop";
    results.figures.push(Figure::without_goal(name, "ns", &wasm["empty"]));
}

/// Makes a group of rows, each with its name and the times in ns by a name.
fn group(
    name: &str,
    (unit, ns): (&str, f64),
    base: &str,
    rows: &[(&str, &Times, &str)],
) -> SeriesGroup {
    let series = rows.iter().filter_map(|(row, times, name)| {
        let values = times.get(name)?.iter().map(|time| time / ns).collect();
        Some(Series { name: (*row).to_owned(), values, ..Series::default() })
    });
    SeriesGroup {
        name: name.to_owned(),
        unit: unit.to_owned(),
        bases: vec![base.to_owned()],
        series: series.collect(),
    }
}

struct TimedWork<'a> {
    at: usize,
    name: &'static str,
    repeated: u64,
    run: Box<dyn FnMut() + 'a>,
}

impl<'a> TimedWork<'a> {
    fn looped(at: usize, name: &'static str, repeated: u64, mut once: impl FnMut() + 'a) -> Self {
        Self { at, name, repeated, run: Box::new(move || (0..repeated).for_each(|_| once())) }
    }

    /// Work that the bench lambda repeats in a wake.
    fn hosted(name: &'static str, repeated: u64) -> Self {
        let mut kernel = HostedKernel::new(name, repeated);
        Self { at: WASM, name, repeated, run: Box::new(move || kernel.frame()) }
    }
}

/// Measures calls of a component and native ones, in an order by `random` in each round, and those
/// in Python after each block of rounds.
fn measured(blocks: u64, rounds: u64, random: &mut XorShift64) -> [Times; 3] {
    let inputs = FilledInputs::new(Vec::new());
    let field = inputs.imu.field("linear_acceleration.x").expect("a field of an IMU");
    let sample = inputs.camera.newest().expect("no holds are refused").expect("a frame");
    let frame = sample.as_frame().expect("an image");
    let source = vec![7_u8; FRAME_BYTES];
    let mut target = source.clone();
    let mut empty = HostedKernel::new("copy", 0);
    let mut works = [
        TimedWork::looped(NATIVE, "call", 100_000, || _ = black_box(inputs.session.now_ns())),
        TimedWork::looped(NATIVE, "column", 200, || {
            drop(black_box(inputs.imu.column(&field, COLUMN)).expect("a column"));
        }),
        TimedWork::looped(NATIVE, "luma-by-host", 4, || drop(black_box(frame.mean_luma(None)))),
        TimedWork::looped(NATIVE, "memcpy", 4, || {
            black_box(&mut target).copy_from_slice(black_box(&source));
        }),
        TimedWork::looped(WASM, "empty", 2000, || empty.tick()),
        TimedWork::hosted("call", 100_000),
        TimedWork::hosted("column", 200),
        TimedWork::hosted("luma-by-host", 4),
        TimedWork::hosted("stream", 4),
        TimedWork::hosted("copy", 4),
        TimedWork::hosted("copy-luma", 4),
    ];
    let mut times = [Times::new(), Times::new(), Times::new()];
    for _ in 0..blocks {
        for _ in 0..rounds {
            for index in shuffled(works.len(), random) {
                let work = &mut works[index];
                let us = timed(work.repeated, || (work.run)()).0;
                times[work.at].entry(work.name).or_default().push(1e3 * us);
            }
        }
        in_python(rounds, &mut times[PYTHON]);
    }
    times
}

/// Replays the lambda that measures itself: a value of each row for each frame.
fn in_python(frames: u64, times: &mut Times) {
    let folder = TempFolder::new();
    let topics = ["/imu/data", "/camera/front/image_raw"];
    let drive = drives::with_frames(&folder, topics, COLUMN, frames);
    let run = replay(&root().join("bench/lambdas/access/python"), &[drive], &["--no-record"]);
    for trigger in run.must_exit(0).decisions.iter().flat_map(|decision| &decision.triggers) {
        let known = ["call", "column", "luma-by-host", "array", "copy", "mean"];
        let name = known.into_iter().find(|name| *name == trigger.label);
        let time = name.zip(trigger.score);
        let (name, ns) = time.expect("the lambda measures these");
        times.entry(name).or_default().push(ns);
    }
    assert_eq!(run.first_fault(), None);
}
