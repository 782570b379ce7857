//! Lambdas of each kind as `gleaner run` runs them, on a recorded drive at its pace: CPU per wake,
//! memory, and the time until a killed process is replaced.

use std::path::Path;
use std::time::Instant;

use gleaner_bench::{BenchResults, Growth, GrowthCurve, Series, SeriesGroup, median};
use gleaner_protocol::{LiveStatus, Report};
use gleaner_tests::live::{RunningProgram, run_all};
use gleaner_tests::{LambdaCopy, TempFolder, sample_drive};
use rustix::process::{Pid, Signal, kill_process};

use super::drives::{self, CAMERA, IMU};
use crate::live::LiveProcesses;
use crate::measure::{Twin, pss_mib};
use crate::rtt::Workload;

const KINDS: [Twin; 2] = [Twin::Rust, Twin::Python];
const FRAMES: LiveLength = LiveLength { warm_up: 5, statuses: 3 };

#[derive(Clone, Copy)]
struct LiveLength {
    /// Wakes before anything is read. By the IMU, 160 include some with a spectrum.
    warm_up: u64,
    /// Statuses that are read, one in a second.
    statuses: usize,
}

#[derive(Default)]
struct LiveKind {
    imu_cpu_us: Vec<f64>,
    camera_cpu_us: Vec<f64>,
    killed_s: Vec<f64>,
    /// Number of lambdas, and memory of all of them in MB.
    memory: Vec<(usize, f64)>,
}

pub(super) fn measure(quick: bool, results: &mut BenchResults) {
    eprintln!("live processes");
    let (rounds, counts, length): (_, &[usize], _) = match quick {
        true => (1, &[1], LiveLength { warm_up: 1, statuses: 2 }),
        false => (5, &[1, 2, 4], LiveLength { warm_up: 160, statuses: 5 }),
    };
    let mut kinds = [LiveKind::default(), LiveKind::default()];
    let folder = TempFolder::new();
    // Enough for three statuses, one in a second, also after a stall.
    let frames = (!quick).then(|| drives::with_frames(&folder, [IMU, CAMERA], 60, 60));
    for _ in 0..rounds {
        for (kind, live) in KINDS.into_iter().zip(&mut kinds) {
            counts.iter().for_each(|count| live.run_imu(kind, *count, length));
            if let Some(frames) = &frames {
                live.run_camera(kind, frames);
            }
        }
    }
    for (name, of) in [
        ("IMU, FFT, live at 100 Hz", (|live| &live.imu_cpu_us) as fn(&LiveKind) -> &Vec<f64>),
        ("1080p, Brake + Dark, live at 10 Hz", |live| &live.camera_cpu_us),
    ] {
        if kinds.iter().all(|live| !of(live).is_empty()) {
            let title = format!("{name}: CPU of the lambda's process per wake");
            results.groups.push(group(&title, "us", &kinds, of));
        }
    }
    results.groups.push(group(
        "A killed process: time until the lambda is ready again",
        "s",
        &kinds,
        |live| &live.killed_s,
    ));
    results.notes.push(
        "*A killed process* is replaced after a pause of 1 s, which doubles with each further kill \
         within a minute; the daemon on a vehicle pauses for 0.1 s if another program killed it."
            .to_owned(),
    );
    let curve = |(kind, live): (Twin, &LiveKind)| GrowthCurve {
        name: kind.to_string(),
        points: counts.iter().map(|count| [*count as f64, live.memory_of(*count)]).collect(),
    };
    results.growths.push(Growth {
        name: "Memory of processes of lambdas (PSS, with their shims)".to_owned(),
        of: "lambdas".to_owned(),
        unit: "MB".to_owned(),
        curves: KINDS.into_iter().zip(&kinds).map(curve).collect(),
    });
}

fn group(
    name: &str,
    unit: &str,
    kinds: &[LiveKind; 2],
    of: impl Fn(&LiveKind) -> &Vec<f64>,
) -> SeriesGroup {
    let series = KINDS.into_iter().zip(kinds).map(|(kind, live)| Series {
        name: kind.to_string(),
        values: of(live).clone(),
        ..Series::default()
    });
    SeriesGroup {
        name: name.to_owned(),
        unit: unit.to_owned(),
        bases: vec![Twin::Rust.to_string()],
        series: series.collect(),
    }
}

impl LiveKind {
    /// Runs `count` lambdas on the IMU of the sample drive. A single one is also measured by its
    /// CPU time, and killed.
    fn run_imu(&mut self, kind: Twin, count: usize, length: LiveLength) {
        let folder = format!("examples/imu-fft/{}", kind.folder());
        let copies: Vec<_> = (0..count)
            .map(|index| LambdaCopy::named(&folder, &format!("imu-fft-{index}")))
            .collect();
        let out = TempFolder::new();
        let started = run_on(&sample_drive(), &copies, &out);
        if count == 1 {
            self.imu_cpu_us.extend(cpu_per_wake(&started, length));
        } else {
            let is_warm = |live: &LiveStatus| live.wakes >= length.warm_up;
            until_all(&started, "the first spectra of all", count, is_warm);
        }
        let processes = LiveProcesses::of(&started);
        let memory = processes.shims.iter().chain(&processes.lambdas).map(|pid| pss_mib(*pid));
        let megabytes = memory.sum::<f64>() * f64::from(1 << 20) / 1e6;
        self.memory.push((count, megabytes));
        if let ([lambda], 1) = (&processes.lambdas[..], count) {
            self.killed_s.push(until_replaced(*lambda, &started));
        }
        started.interrupt();
    }

    fn run_camera(&mut self, kind: Twin, drive: &Path) {
        let out = TempFolder::new();
        let started = run_on(drive, &[Workload::Brake1080.lambda(kind)], &out);
        self.camera_cpu_us.extend(cpu_per_wake(&started, FRAMES));
        started.interrupt();
    }

    fn memory_of(&self, count: usize) -> f64 {
        let of_count = self.memory.iter().filter(|(lambdas, _)| *lambdas == count);
        median(&of_count.map(|(_, megabytes)| *megabytes).collect::<Vec<_>>()).unwrap_or(f64::NAN)
    }
}

fn run_on(drive: &Path, lambdas: &[LambdaCopy], out: &TempFolder) -> RunningProgram {
    let folders: Vec<&Path> = lambdas.iter().map(LambdaCopy::path).collect();
    let drive = drive.to_str().expect("a plain name");
    let started = run_all(&folders, out.path(), &["--no-record", "--drive", drive]);
    if lambdas.len() == 1 {
        started.until_ready();
    }
    started
}

/// Returns the CPU time of a lambda's process per wake in us, between each two of its statuses.
fn cpu_per_wake(started: &RunningProgram, length: LiveLength) -> Vec<f64> {
    let LiveLength { warm_up, statuses } = length;
    let mut before = started.until_live("the first wakes", |live| live.wakes >= warm_up);
    let between = |_| {
        let live = started.until_live("a status", |_| true);
        let us = 1e6 * (live.cpu_s - before.cpu_s) / (live.wakes - before.wakes) as f64;
        before = live;
        us
    };
    (1..statuses).map(between).collect()
}

/// Waits until `count` lambdas of a run have each reported a status that `is_reached` accepts.
pub(super) fn until_all(
    started: &RunningProgram,
    what: &str,
    count: usize,
    is_reached: impl Fn(&LiveStatus) -> bool,
) {
    let mut reached = Vec::new();
    started.until_named(what, |name, report| {
        if let Report::Live(live) = report
            && is_reached(&live)
            && !reached.contains(&name)
        {
            reached.push(name);
        }
        (reached.len() == count).then_some(())
    });
}

/// Kills a lambda's process; returns the time until the `init` of the next one has returned, in s.
/// The new process answers the samples of the meantime first.
fn until_replaced(lambda: u32, started: &RunningProgram) -> f64 {
    let pid = i32::try_from(lambda).ok().and_then(Pid::from_raw).expect("a process id");
    let killed = Instant::now();
    kill_process(pid, Signal::KILL).expect("the process runs");
    started.until_ready();
    killed.elapsed().as_secs_f64()
}
