//! Replays: their speed in both kinds of lambdas, growth of memory, and what a journal costs.
//!
//! Variants are measured in alternating runs on one core.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_bench::Figure;
use gleaner_protocol::{ReplaySummary, Report, Round};
use gleaner_tests::drive::imu_only;
use gleaner_tests::{TempFolder, program, replay, sample_drive};

use crate::measure::Twin;

/// All figures.
pub fn figures(quick: bool) -> Vec<Figure> {
    let rounds = if quick { 1 } else { 9 };
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

    let outputs = || [("", Vec::new()), ("journal", Vec::new()), ("clips", Vec::new())];
    let [imu, sample] = [
        alternate(rounds, outputs(), |output| bench.hello_rounds(&bench.imu, output)),
        alternate(rounds, outputs(), |output| bench.hello_rounds(&bench.sample, output)),
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
    figures
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

struct ReplayBench {
    /// Most of it is images, which `hello` does not read.
    sample: PathBuf,
    /// 200 s of IMU alone.
    imu: PathBuf,
    _folder: TempFolder,
}

impl ReplayBench {
    fn new() -> Self {
        let folder = TempFolder::new();
        Self { sample: sample_drive(), imu: imu_only(&folder, 5), _folder: folder }
    }

    /// `hello` over the sample drive: a wake for each of 4,170 IMU samples.
    fn hello(&self, kind: Twin) -> ReplaySummary {
        self.run(&kind.example("hello"), &["--set", "brake_mps2=-1.4", "--no-record"])
    }

    /// `brake-dark` over the sample drive, configured to inspect each of its 400 images.
    fn every_frame_decoded(&self, kind: Twin) -> ReplaySummary {
        self.run(
            &kind.example("brake-dark"),
            &["--set", "brake_mps2=1000", "--set", "dark_luma=0", "--no-record"],
        )
    }

    fn run(&self, lambda: &Path, args: &[&str]) -> ReplaySummary {
        replay(lambda, std::slice::from_ref(&self.sample), args)
            .must_exit(0)
            .summary
            .clone()
            .expect("a summary")
    }

    /// Growth of memory from the 2nd to the 10th replay of `example` in one process, in %.
    fn growth_from_2nd_to_10th(&self, example: &str, kind: Twin) -> f64 {
        let args = ["--set", "brake_mps2=-1.4", "--repeat", "10"];
        let rounds = self.rounds(&kind.example(example), &self.sample, &args);
        100.0 * (rounds[9].rss_bytes as f64 / rounds[1].rss_bytes as f64 - 1.0)
    }

    /// Median wakes per second of 20 passes of `hello` in wasm over `drive`, in one process:
    /// decisions only, with a `journal`, or with `clips`. A single pass of 20 ms would be too
    /// noisy.
    fn hello_rounds(&self, drive: &Path, what: &str) -> f64 {
        let folder = TempFolder::new();
        let journal = folder.path().join("wakes.journal");
        let mut args = vec!["--set", "brake_mps2=-1.4", "--repeat", "20"];
        match what {
            "journal" => {
                args.extend(["--no-record", "--journal", journal.to_str().expect("a plain name")])
            }
            "clips" => {}
            _ => args.push("--no-record"),
        }
        let rounds = self.rounds(&Twin::Rust.example("hello"), drive, &args);
        let mut rates = rounds.iter().map(|round| round.wakes_per_s).collect::<Vec<_>>();
        rates.sort_by(f64::total_cmp);
        rates[rates.len() / 2]
    }

    /// Bytes per wake of the journal of `example` in wasm.
    fn journal_bytes_per_wake(&self, example: &str) -> f64 {
        let folder = TempFolder::new();
        let journal = folder.path().join("wakes.journal");
        let args = [
            "--set",
            "brake_mps2=-1.4",
            "--no-record",
            "--journal",
            journal.to_str().expect("a plain name"),
        ];
        let summary = self.run(&Twin::Rust.example(example), &args);
        std::fs::metadata(&journal).expect("a journal").len() as f64 / summary.wakes as f64
    }

    fn rounds(&self, lambda: &Path, drive: &Path, args: &[&str]) -> Vec<Round> {
        let out = TempFolder::new();
        let output = Command::new(program("gleaner-runtime"))
            .arg("replay")
            .arg(lambda)
            .arg(drive)
            .args(args)
            .arg("--out")
            .arg(out.path())
            .output()
            .expect("gleaner-runtime starts");
        let lines = String::from_utf8_lossy(&output.stdout).into_owned();
        let reports = lines.lines().filter_map(|line| serde_json::from_str(line).ok());
        let rounds = reports.filter_map(|report| match report {
            Report::Round(round) => Some(round),
            _ => None,
        });
        let rounds = rounds.collect::<Vec<_>>();
        assert!(rounds.len() >= 10, "{}", String::from_utf8_lossy(&output.stderr));
        rounds
    }
}
