//! Runs single measurements, and formats a series of them as a row.

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_protocol::{ReplaySummary, Report, Round};
use gleaner_tests::drive::{IMAGE, image, imu_only, one_topic};
use gleaner_tests::{TempFolder, program, replay, root, sample_drive};

/// The two versions of a lambda.
#[derive(Clone, Copy)]
pub enum Twin {
    Rust,
    Python,
}

impl fmt::Display for Twin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Rust => "wasm",
            Self::Python => "Python",
        })
    }
}

impl Twin {
    /// The folder of this version.
    pub fn folder(self) -> &'static str {
        match self {
            Self::Rust => "rust",
            Self::Python => "python",
        }
    }

    fn example(self, name: &str) -> PathBuf {
        root().join("examples").join(name).join(self.folder())
    }
}

/// Binds this process and its children to the first core that it may use.
pub fn bind_to_one_core() -> std::io::Result<()> {
    bind_to(cores()?.first().copied().unwrap_or(0))
}

/// The cores that this thread may use.
pub fn cores() -> std::io::Result<Vec<usize>> {
    let allowed = rustix::thread::sched_getaffinity(None)?;
    Ok((0..rustix::thread::CpuSet::MAX_CPU).filter(|core| allowed.is_set(*core)).collect())
}

/// Binds this thread, and the threads and processes that it will start, to one core.
pub fn bind_to(core: usize) -> std::io::Result<()> {
    let mut one = rustix::thread::CpuSet::new();
    one.set(core);
    Ok(rustix::thread::sched_setaffinity(None, &one)?)
}

/// Drives for the replay benchmarks.
pub struct ReplayBench {
    sample: PathBuf,
    frames: PathBuf,
    imu: PathBuf,
    _folders: [TempFolder; 2],
}

impl ReplayBench {
    pub fn new() -> Self {
        let folder = TempFolder::new();
        let pixels = vec![99; 1920 * 1080 * 3];
        let frames = (0..4)
            .map(|i| (i * 100_000_000, image(1920, 1080, "bgr8", 5760, &pixels)))
            .collect::<Vec<_>>();
        let frames =
            one_topic(&folder, "/camera/front/image_raw", "sensor_msgs/msg/Image", IMAGE, &frames);
        let imu_folder = TempFolder::new();
        let imu = imu_only(&imu_folder, 5);
        Self { sample: sample_drive(), frames, imu, _folders: [folder, imu_folder] }
    }

    /// `hello` over the sample drive: a wake for each of 4,170 IMU samples.
    pub fn hello(&self, kind: Twin) -> ReplaySummary {
        self.run(&kind.example("hello"), &["--set", "brake_mps2=-1.4", "--no-record"])
    }

    /// `brake-dark` over the sample drive, configured to inspect each of its 400 images.
    pub fn every_frame_decoded(&self, kind: Twin) -> ReplaySummary {
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
    pub fn growth_from_2nd_to_10th(&self, example: &str, kind: Twin) -> f64 {
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

    /// [`ReplayBench::hello_rounds`] over the sample drive, most of which is images that the lambda
    /// does not read.
    pub fn sample_rounds(&self, what: &str) -> f64 {
        self.hello_rounds(&self.sample, what)
    }

    /// [`ReplayBench::hello_rounds`] over 200 s of IMU alone.
    pub fn imu_rounds(&self, what: &str) -> f64 {
        self.hello_rounds(&self.imu, what)
    }

    /// Bytes per wake of the journal of `example` in wasm.
    pub fn journal_bytes_per_wake(&self, example: &str) -> f64 {
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

    /// Nanoseconds to create an array over a frame of 6.2 MB, one value for each frame, measured by
    /// the lambda.
    pub fn array_ns(&self) -> Vec<f64> {
        let lambda = root().join("bench/lambdas/ndarray/python");
        let run = replay(&lambda, std::slice::from_ref(&self.frames), &[]);
        let triggers = run.must_exit(0).decisions.iter().flat_map(|decision| &decision.triggers);
        triggers.filter_map(|trigger| trigger.score).collect()
    }
}

/// The `share` quantile of `values`; NaN if there are none.
pub fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get((share * sorted.len() as f64) as usize).copied().unwrap_or(f64::NAN)
}

/// One row of the table.
pub struct Figure {
    name: String,
    unit: &'static str,
    goal: Option<(f64, bool)>,
    median: f64,
    spread: (f64, f64),
    runs: usize,
}

impl Figure {
    pub fn at_least(name: &str, unit: &'static str, goal: f64, values: &[f64]) -> Self {
        Self { goal: Some((goal, true)), ..Self::without_goal(name, unit, values) }
    }

    pub fn at_most(name: &str, unit: &'static str, goal: f64, values: &[f64]) -> Self {
        Self { goal: Some((goal, false)), ..Self::without_goal(name, unit, values) }
    }

    /// A figure without a goal.
    pub fn without_goal(name: &str, unit: &'static str, values: &[f64]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let at = |index: usize| sorted.get(index).copied().unwrap_or(f64::NAN);
        let last = sorted.len().saturating_sub(1);
        Self {
            name: name.to_owned(),
            unit,
            goal: None,
            median: f64::midpoint(at(last / 2), at(last.div_ceil(2))),
            spread: (at(0), at(last)),
            runs: sorted.len(),
        }
    }

    pub fn is_met(&self) -> bool {
        match self.goal {
            Some((goal, true)) => self.median >= goal,
            Some((goal, false)) => self.median <= goal,
            None => true,
        }
    }
}

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, unit, median, spread: (low, high), runs, .. } = self;
        let goal = match self.goal {
            Some((goal, true)) => format!(">= {goal} {unit}"),
            Some((goal, false)) => format!("<= {goal} {unit}"),
            None => "-".to_owned(),
        };
        let result = match (self.goal.is_some(), self.is_met()) {
            (false, _) => "",
            (true, true) => "met",
            (true, false) => "not met",
        };
        let digits = if median.abs() < 100.0 { 2 } else { 0 };
        write!(
            f,
            "| {name} | {goal} | {median:.digits$} {unit} \
             | {low:.digits$} to {high:.digits$} | {runs} | {result} |"
        )
    }
}
