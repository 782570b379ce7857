//! Measures what Gleaner promises, with the programs that users run. `cargo xtask bench` builds what it needs first.
//!
//! Kinds of lambda are measured in alternating runs on one core; each row gives the median and the spread of its runs.

mod measure;

use std::process::ExitCode;

use clap::Parser;
use measure::{Figure, Kind, Setting};

/// Prints a table of promises with what was measured, in Markdown.
#[derive(Parser)]
struct Args {
    /// Fewer rounds: shows that the benches run, not what they say.
    #[arg(long)]
    quick: bool,
}

fn main() -> ExitCode {
    let Args { quick } = Args::parse();
    let rounds = if quick { 2 } else { 9 };
    if let Err(error) = measure::stay_on_one_core() {
        eprintln!("cannot stay on one core, figures are of all: {error}");
    }
    let setting = Setting::new();
    let mut figures = Vec::new();

    let imu = [Kind::Rust, Kind::Python].map(|kind| (kind, Vec::new()));
    let imu = alternate(rounds, imu, |kind| setting.hello(kind).wakes_per_s);
    figures.push(Figure::at_least("replay, IMU only, wasm", "wakes/s", 25_000.0, &imu[0].1));
    figures.push(Figure::at_least("replay, IMU only, Python", "wakes/s", 5_000.0, &imu[1].1));

    let camera = [Kind::Rust, Kind::Python].map(|kind| (kind, Vec::new()));
    let mut shares = Vec::new();
    let camera = alternate(rounds, camera, |kind| {
        let summary = setting.every_frame_decoded(kind);
        shares.push(100.0 * summary.decode_s / summary.wall_s);
        summary.wakes_per_s
    });
    figures.push(Figure::told("replay, 640x360 JPEG, every frame decoded, wasm", "frames/s", &camera[0].1));
    figures.push(Figure::told("replay, 640x360 JPEG, every frame decoded, Python", "frames/s", &camera[1].1));
    figures.push(Figure::told("share of JPEG decoding in these", "%", &shares));

    for example in ["hello", "brake-dark"] {
        for kind in [Kind::Rust, Kind::Python] {
            let growth = (0..rounds.min(3)).map(|_| setting.growth_from_2nd_to_10th(example, kind));
            let name = format!("memory after the 10th replay of {example} in one process against the 2nd, {kind}");
            figures.push(Figure::at_most(&name, "%", 2.0, &growth.collect::<Vec<_>>()));
        }
    }
    let arrays = (0..rounds.min(5)).flat_map(|_| setting.array_ns()).collect::<Vec<_>>();
    figures.push(Figure::at_most("slot to ndarray, 1920x1080 bgr8 (6.2 MB)", "ns", 1000.0, &arrays));

    println!("| promise | goal | median | spread | runs | |\n|---|---|---|---|---|---|");
    for figure in &figures {
        println!("{figure}");
    }
    // Two rounds on a busy machine say nothing about a promise.
    if quick || figures.iter().all(Figure::is_met) { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs `measure` for each kind in turn, `rounds` times, so that a change of the machine's mood meets all alike.
fn alternate<const N: usize>(
    rounds: usize,
    mut series: [(Kind, Vec<f64>); N],
    mut measure: impl FnMut(Kind) -> f64,
) -> [(Kind, Vec<f64>); N] {
    for _ in 0..rounds {
        for (kind, values) in &mut series {
            values.push(measure(*kind));
        }
    }
    series
}
