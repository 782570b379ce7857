//! Measures long drives: the time of `gleaner inspect` and of a replay.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use gleaner_protocol::{DriveInfo, ReplaySummary};
use gleaner_tests::{TempFolder, bag, program, python_home, replay, root, sample_drive};

use gleaner_bench::python;
use gleaner_bench::{BenchResults, Figure};

/// Copies of the sample drive that make 2 GB.
const ROUNDS: u64 = 265;

/// Measures a drive of 2 GB in each storage; a tenth of that if `quick`.
pub fn measure(quick: bool, results: &mut BenchResults) {
    let rounds = if quick { ROUNDS / 10 } else { ROUNDS };
    let folder = TempFolder::new();
    let mcap = folder.path().join("drive.mcap");
    bag::mcap(&mcap, rounds);
    let directory = bag::directory(&folder, rounds);
    let short = hello(&sample_drive(), "rust").peak_rss_bytes;
    match rosbags_unavailable() {
        None => results.figures = against_rosbags(quick),
        Some(why) => results.notes.push(format!("the script on rosbags is skipped: {why}")),
    }
    for (name, drive, file) in
        [("MCAP", &mcap, &mcap), ("sqlite3", &directory, &directory.join("drive_0.db3"))]
    {
        let bytes = std::fs::metadata(file).expect("it was written").len();
        let mut add = |what: &str, unit, value: f64| {
            results.figures.push(Figure::without_goal(&format!("{name}: {what}"), unit, &[value]))
        };
        add("size", "GB", bytes as f64 / 1e9);
        let summary = hello(drive, "rust");
        assert_eq!(summary.wakes, rounds * 4170, "every IMU sample wakes");
        add("replay by hello", "s", summary.wall_s);
        add("replay by hello", "wakes/s", summary.wakes_per_s);
        let growth = summary.peak_rss_bytes as f64 - short as f64;
        let what = format!("{name}: additional memory against a replay of the sample drive");
        results.figures.push(Figure::at_most(&what, "MiB", 16.0, &[growth / 1024.0 / 1024.0]));
        let opened: Vec<_> = (0..if quick { 2 } else { 9 }).map(|_| inspect_ms(drive)).collect();
        let what = format!("{name}: gleaner inspect");
        results.figures.push(Figure::at_most(&what, "ms", 1000.0, &opened));
    }
}

/// The reason why the script on rosbags cannot run; `None` if it can.
fn rosbags_unavailable() -> Option<String> {
    let output = Command::new(python()).args(["-I", "-c", "import rosbags"]).output();
    match output {
        Ok(output) if output.status.success() => None,
        Ok(output) => {
            let text = String::from_utf8_lossy(&output.stderr);
            Some(text.lines().last().unwrap_or("rosbags cannot be imported").to_owned())
        }
        Err(error) => Some(format!("cannot start `{}`: {error}", python().display())),
    }
}

/// Runs the same function over a drive of 200 MB in lambdas and in a script on rosbags,
/// alternating. The unit is wakes per second from the first message to the last.
fn against_rosbags(quick: bool) -> Vec<Figure> {
    let folder = TempFolder::new();
    let drive = folder.path().join("drive.mcap");
    let rounds = ROUNDS / 10;
    bag::mcap(&drive, rounds);
    let mut rates = [const { Vec::new() }; 3];
    for _ in 0..if quick { 1 } else { 5 } {
        let (wasm, python) = (hello(&drive, "rust"), hello(&drive, "python"));
        let (messages, hits, seconds) = rosbags(&drive);
        assert_eq!(
            (messages, hits),
            (rounds * 4170, python.triggers),
            "all make the same decisions"
        );
        assert_eq!(wasm.triggers, python.triggers);
        rates[0].push(wasm.wakes_per_s);
        rates[1].push(python.wakes_per_s);
        rates[2].push(messages as f64 / seconds);
    }
    let names = ["hello in wasm", "hello in Python", "the same function in a script on rosbags"];
    let figures = names.iter().zip(&rates).map(|(name, rates)| {
        Figure::without_goal(&format!("MCAP, 0.2 GB: {name}"), "wakes/s", rates)
    });
    let factor =
        rates[1].iter().zip(&rates[2]).map(|(lambda, script)| lambda / script).collect::<Vec<_>>();
    figures
        .chain([Figure::without_goal("replay in Python against rosbags", "x", &factor)])
        .collect()
}

/// Messages, triggers and seconds of the script.
fn rosbags(drive: &Path) -> (u64, u64, f64) {
    let output = Command::new(python())
        .env("PYTHONPATH", python_home())
        .arg(root().join("bench/rosbags_loop.py"))
        .args([drive, &root().join("examples/hello/python")])
        .arg(BRAKE_MPS2)
        .output()
        .expect("python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let result: serde_json::Value =
        serde_json::from_slice(&output.stdout).expect("one JSON object");
    let count = |key: &str| result[key].as_u64().expect("a count");
    (count("messages"), count("hits"), result["seconds"].as_f64().expect("seconds"))
}

/// A threshold at which `hello` triggers on the sample drive.
const BRAKE_MPS2: &str = "-1.4";

fn hello(drive: &Path, kind: &str) -> ReplaySummary {
    let threshold = format!("brake_mps2={BRAKE_MPS2}");
    let args = ["--set", threshold.as_str(), "--no-record"];
    let run = replay(&root().join("examples/hello").join(kind), &[drive.to_owned()], &args);
    assert_eq!(run.exit, 0, "{}", run.stderr);
    run.summary.expect("a replay ends with a summary")
}

/// Time of `gleaner inspect` in ms, including the start of its two programs.
fn inspect_ms(drive: &Path) -> f64 {
    let started = Instant::now();
    let output = Command::new(program("gleaner"))
        .args(["inspect", "--json"])
        .arg(drive)
        .output()
        .expect("gleaner starts");
    let ms = started.elapsed().as_secs_f64() * 1e3;
    let seen: DriveInfo = serde_json::from_slice(&output.stdout).expect("topics of a drive");
    assert_eq!(seen.topics.len(), 3);
    ms
}
