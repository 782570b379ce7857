//! Long drives: how long it takes to see what is in one, and what replaying it takes.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use gleaner_protocol::{DriveSeen, Summary};
use gleaner_tests::{Folder, bag, program, replay, root, sample_drive};

use crate::measure::Figure;

/// The sample drive so often is 2 GB.
const ROUNDS: u64 = 265;

/// What is measured of a drive of 2 GB in each storage; a tenth of that if `quick`.
pub fn figures(quick: bool) -> Vec<Figure> {
    let rounds = if quick { ROUNDS / 10 } else { ROUNDS };
    let folder = Folder::new();
    let mcap = folder.path().join("drive.mcap");
    bag::mcap(&mcap, rounds);
    let directory = bag::directory(&folder, rounds);
    let short = hello(&sample_drive()).peak_rss_bytes;
    let mut figures = Vec::new();
    for (name, drive, file) in [("MCAP", &mcap, &mcap), ("sqlite3", &directory, &directory.join("drive_0.db3"))] {
        let bytes = std::fs::metadata(file).expect("it was written").len();
        let mut tell =
            |what: &str, unit, value: f64| figures.push(Figure::told(&format!("{name}: {what}"), unit, &[value]));
        tell("size", "GB", bytes as f64 / 1e9);
        let summary = hello(drive);
        assert_eq!(summary.wakes, rounds * 4170, "every IMU sample wakes");
        tell("replay by hello", "s", summary.wall_s);
        tell("replay by hello", "wakes/s", summary.wakes_per_s);
        let growth = summary.peak_rss_bytes as f64 - short as f64;
        let what = format!("{name}: memory of that beyond a replay of the sample drive");
        figures.push(Figure::at_most(&what, "MiB", 16.0, &[growth / 1024.0 / 1024.0]));
        let opened: Vec<_> = (0..if quick { 2 } else { 9 }).map(|_| inspect_ms(drive)).collect();
        figures.push(Figure::at_most(&format!("{name}: gleaner inspect"), "ms", 1000.0, &opened));
    }
    figures
}

fn hello(drive: &Path) -> Summary {
    let args = ["--set", "brake_mps2=-1.4", "--no-record"];
    let run = replay(&root().join("examples/hello/rust"), &[drive.to_owned()], &args);
    assert_eq!(run.exit, 0, "{}", run.stderr);
    run.summary.expect("a replay ends with a summary")
}

/// How long `gleaner inspect` takes, the start of its two programs included.
fn inspect_ms(drive: &Path) -> f64 {
    let started = Instant::now();
    let output =
        Command::new(program("gleaner")).args(["inspect", "--json"]).arg(drive).output().expect("gleaner starts");
    let ms = started.elapsed().as_secs_f64() * 1e3;
    let seen: DriveSeen = serde_json::from_slice(&output.stdout).expect("topics of a drive");
    assert_eq!(seen.topics.len(), 3);
    ms
}
