//! Measures Gleaner against its performance goals, with the programs that users run.
//! `cargo xtask bench` builds these programs first.
//!
//! Variants of a replay are measured in alternating runs on one core. Each row gives the median,
//! the lowest and the highest value of its runs.

mod answers;
mod drives;
mod inference;
mod isolation;
mod kernels;
mod live;
mod measure;
mod record;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use gleaner_lambda::manifest::Store;
use measure::{Figure, ReplayBench, Twin, quantile};

/// Measures Gleaner against its performance goals and prints a table in Markdown.
#[derive(Parser)]
struct Args {
    /// Fewer and shorter rounds: tests the benches themselves; the values are not meaningful.
    #[arg(long)]
    quick: bool,
    /// Live topics instead of drives, in a private network; needs gleaner-player.
    #[arg(long)]
    live: bool,
    /// Of live topics only the round trips, against a bare reader.
    #[arg(long, conflicts_with_all = ["live", "kernels", "drives", "isolation"])]
    rtt: bool,
    /// Of live topics only what one and several lambdas receive and cost.
    #[arg(long, conflicts_with_all = ["live", "rtt", "kernels", "drives", "isolation"])]
    load: bool,
    /// Arithmetic in lambdas against the same code natively, and calls between lambda and host,
    /// instead of drives.
    #[arg(long, conflicts_with = "live")]
    kernels: bool,
    /// Drives of 2 GB in each storage format, instead of short ones; takes 5 GB of disk.
    #[arg(long, conflicts_with_all = ["live", "kernels", "isolation"])]
    drives: bool,
    /// Effect of a misbehaving lambda on others, in a private network, and the cost of a process
    /// for each lambda, instead of drives; needs gleaner-player.
    #[arg(long, conflicts_with_all = ["live", "kernels"])]
    isolation: bool,
    /// Detectors: a frame's way through gleaner-inference, by rten and, if ORT_DYLIB_PATH is set,
    /// by ONNX Runtime, against a plain Python program; several lambdas of one model.
    #[arg(long, conflicts_with_all = ["live", "rtt", "load", "kernels", "drives", "isolation"])]
    inference: bool,
    #[command(subcommand)]
    command: Option<BenchCommand>,
}

#[derive(Subcommand)]
enum BenchCommand {
    /// Writes a model of the shape of YOLO11, with random weights, and measures nothing.
    Model {
        /// Scale of the model.
        scale: inference::GraphScale,
        /// The file to write.
        file: PathBuf,
    },
}

fn main() -> ExitCode {
    let Args { quick, live, rtt, load, kernels, drives, isolation, inference, command } =
        Args::parse();
    if let Some(BenchCommand::Model { scale, file }) = command {
        return write_model(scale, &file);
    }
    if inference {
        inference::measure(quick);
        return ExitCode::SUCCESS;
    }
    if live || rtt || load || isolation {
        let figures = match live::in_private_network() {
            Some(Ok(true)) => return ExitCode::SUCCESS,
            Some(Ok(false)) => return ExitCode::FAILURE,
            Some(Err(why)) => Err(why),
            None if isolation => isolation::figures(quick),
            None if rtt => Ok(live::round_trips(quick)),
            None if load => Ok(live::loads(quick)),
            None => Ok(live::figures(quick)),
        };
        return match figures {
            Ok(figures) => report(&figures, quick),
            Err(why) => {
                println!("skipped: {why}");
                ExitCode::SUCCESS
            }
        };
    }
    let rounds = if quick { 1 } else { 9 };
    if let Err(error) = measure::bind_to_one_core() {
        eprintln!("cannot bind to one core, measuring on all cores: {error}");
    }
    if kernels {
        return report(&kernels::figures(quick), quick);
    }
    if drives {
        return report(&drives::figures(quick), quick);
    }
    let bench = ReplayBench::new();
    let mut figures = Vec::new();

    let imu = [Twin::Rust, Twin::Python].map(|kind| (kind, Vec::new()));
    let imu = alternate(rounds, imu, |kind| bench.hello(kind).wakes_per_s);
    figures.push(Figure::at_least("replay, IMU only, wasm", "wakes/s", 25_000.0, &imu[0].1));
    figures.push(Figure::at_least("replay, IMU only, Python", "wakes/s", 5_000.0, &imu[1].1));

    let camera = [Twin::Rust, Twin::Python].map(|kind| (kind, Vec::new()));
    let mut shares = Vec::new();
    let camera = alternate(rounds, camera, |kind| {
        let summary = bench.every_frame_decoded(kind);
        shares.push(100.0 * summary.decode_s / summary.wall_s);
        summary.wakes_per_s
    });
    figures.push(Figure::without_goal(
        "replay, 640x360 JPEG, every frame decoded, wasm",
        "frames/s",
        &camera[0].1,
    ));
    figures.push(Figure::without_goal(
        "replay, 640x360 JPEG, every frame decoded, Python",
        "frames/s",
        &camera[1].1,
    ));
    figures.push(Figure::without_goal("share of JPEG decoding in these", "%", &shares));

    for example in ["hello", "brake-dark"] {
        for kind in [Twin::Rust, Twin::Python] {
            let growth = (0..rounds.min(3)).map(|_| bench.growth_from_2nd_to_10th(example, kind));
            let name = format!(
                "memory growth from the 2nd to the 10th replay of {example} in one process, {kind}"
            );
            figures.push(Figure::at_most(&name, "%", 2.0, &growth.collect::<Vec<_>>()));
        }
    }
    let arrays = (0..rounds.min(5)).flat_map(|_| bench.array_ns()).collect::<Vec<_>>();
    figures.push(Figure::at_most(
        "slot to ndarray, 1920x1080 bgr8 (6.2 MB)",
        "ns",
        1000.0,
        &arrays,
    ));

    let outputs = || [("", Vec::new()), ("journal", Vec::new()), ("clips", Vec::new())];
    let [imu, sample] = [
        alternate(rounds, outputs(), |output| bench.imu_rounds(output)),
        alternate(rounds, outputs(), |output| bench.sample_rounds(output)),
    ];
    let slowdown_percent = |replays: &[(&str, Vec<f64>); 3], output: usize| {
        let rates = replays[0].1.iter().zip(&replays[output].1);
        rates.map(|(without, with)| 100.0 * (without / with - 1.0)).collect::<Vec<_>>()
    };
    figures.push(Figure::at_most(
        "replay slowdown by a journal, 200 s of IMU, wasm",
        "%",
        5.0,
        &slowdown_percent(&imu, 1),
    ));
    figures.push(Figure::without_goal(
        "replay slowdown by a journal, sample drive with camera, wasm",
        "%",
        &slowdown_percent(&sample, 1),
    ));
    figures.push(Figure::without_goal(
        "replay slowdown by clips, sample drive with camera, wasm",
        "%",
        &slowdown_percent(&sample, 2),
    ));
    let sizes = [("hello", 14.0), ("brake-dark", 20.0)];
    for (example, goal) in sizes {
        let name = format!("journal of {example}");
        figures.push(Figure::at_most(
            &name,
            "bytes/wake",
            goal,
            &[bench.journal_bytes_per_wake(example)],
        ));
    }

    for (name, store) in [("memory", Store::Ram), ("disk", Store::Disk)] {
        let load = record::record(if quick { 2 } else { 60 }, store);
        let mut add = |what: &str, unit, value| {
            figures.push(Figure::without_goal(
                &format!("recorder at 20 MB/s, preroll in {name}: {what}"),
                unit,
                &[value],
            ));
        };
        add("arrived", "MB/s", load.megabytes_per_s);
        add("share of time in clips", "%", load.recorded_percent);
        add("share of a core", "%", load.cpu_percent);
        // 64 MiB for a preroll in memory, and 16 MiB for a chunk of a clip and its compression.
        let bound = if store == Store::Ram { 64.0 + 16.0 } else { 16.0 };
        let memory = format!("recorder at 20 MB/s, preroll in {name}: memory");
        figures.push(Figure::at_most(&memory, "MiB", bound, &[load.memory_mib]));
        let name = format!("recorder at 20 MB/s, preroll in {name}: preroll against its limit");
        figures.push(Figure::at_most(&name, "%", 100.0, &[load.preroll_percent]));
    }

    let live = record::record_live(if quick { 4 } else { 60 });
    let opened_ms = |share| quantile(&live.opened_ms, share);
    figures.push(Figure::without_goal(
        "trigger to window open, at 20 MB/s: p50",
        "ms",
        &[opened_ms(0.5)],
    ));
    figures.push(Figure::at_most(
        "trigger to window open, at 20 MB/s: p99",
        "ms",
        1.0,
        &[opened_ms(0.99)],
    ));
    figures.push(Figure::without_goal(
        "trigger to window open, at 20 MB/s: max",
        "ms",
        &live.opened_ms[live.opened_ms.len().max(1) - 1..],
    ));
    figures.push(Figure::without_goal(
        "live recorder at 20 MB/s: max time to accept a sample",
        "ms",
        &[live.longest_ms],
    ));
    figures.push(Figure::without_goal(
        "live recorder: time to send a wake, p50",
        "us",
        &[quantile(&live.sent_us, 0.5)],
    ));
    figures.push(Figure::at_most(
        "live recorder at 20 MB/s: lost samples",
        "samples",
        0.0,
        &[live.lost as f64],
    ));

    report(&figures, quick)
}

fn write_model(scale: inference::GraphScale, file: &Path) -> ExitCode {
    let (model, parameters) = inference::yolo_shaped(scale);
    match std::fs::write(file, &model) {
        Ok(()) => {
            println!("{}: {parameters} parameters, {} bytes", file.display(), model.len());
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: cannot write `{}`\n  cause: {error}", file.display());
            ExitCode::FAILURE
        }
    }
}

fn report(figures: &[Figure], quick: bool) -> ExitCode {
    println!("| measurement | goal | median | spread | runs | |\n|---|---|---|---|---|---|");
    for figure in figures {
        println!("{figure}");
    }
    // The goals do not count in a quick run: one round on a busy machine is not significant.
    if quick || figures.iter().all(Figure::is_met) { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs `measure` for each of `series` in turn, `rounds` times, so that changes of the machine's
/// speed affect all of them alike.
fn alternate<K: Copy, const N: usize>(
    rounds: usize,
    mut series: [(K, Vec<f64>); N],
    mut measure: impl FnMut(K) -> f64,
) -> [(K, Vec<f64>); N] {
    for _ in 0..rounds {
        for (kind, values) in &mut series {
            values.push(measure(*kind));
        }
    }
    series
}
