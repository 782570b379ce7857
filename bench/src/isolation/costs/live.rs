//! Lambdas of each kind as `gleaner run` runs them, on a recorded drive at its pace: CPU per wake,
//! memory, and the time until a killed process is replaced.

use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_bench_results::{
    BenchResults, Growth, GrowthCurve, IsolationCosts, KindValues, Series, SeriesGroup, quantile,
};
use gleaner_lambda::Decision;
use gleaner_protocol::Report;
use gleaner_tests::live::{PATIENCE, RunningProgram, run_all};
use gleaner_tests::{LambdaCopy, TempFolder, sample_drive};
use gleaner_transport::Clock;
use rustix::process::{Pid, Signal, kill_process};

use crate::live::LiveProcesses;
use crate::measure::{Twin, pss_mib};

const KINDS: [Twin; 2] = [Twin::Rust, Twin::Python];
/// Wakes of each lambda before its memory is read: some have computed a spectrum.
const WARM_UP: u64 = 160;

/// Measurements of one kind.
#[derive(Default)]
struct LiveKind {
    cpu_us: Vec<f64>,
    killed_s: Vec<f64>,
    /// Number of lambdas, and memory of all of them in MB.
    memory: Vec<(usize, f64)>,
}

pub(super) fn measure(quick: bool, results: &mut BenchResults, costs: &mut IsolationCosts) {
    eprintln!("live processes");
    let (rounds, counts, statuses): (_, &[usize], _) =
        if quick { (1, &[1], 2) } else { (5, &[1, 2, 4], 5) };
    let mut kinds = [LiveKind::default(), LiveKind::default()];
    for _ in 0..rounds {
        for count in counts {
            for (kind, live) in KINDS.into_iter().zip(&mut kinds) {
                live.run(kind, *count, statuses);
            }
        }
    }
    results.groups.push(group(
        "IMU, FFT, live at 100 Hz: CPU of the lambda's process per wake",
        "us",
        &kinds,
        |live| &live.cpu_us,
    ));
    results.groups.push(group(
        "A killed process: time until the lambda answers again",
        "s",
        &kinds,
        |live| &live.killed_s,
    ));
    results.notes.push(
        "*A killed process* is replaced after a pause of 1 s, which doubles with each kill within \
         a minute; the daemon on a vehicle pauses for 0.1 s if another program kills it."
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
    costs.first_lambda_mb = values(&kinds, |live| Some(live.memory_of(1)));
    costs.further_lambda_mb = values(&kinds, |live| {
        let [first, .., last] = counts else { return None };
        let grown = live.memory_of(*last) - live.memory_of(*first);
        Some(grown / (last - first) as f64)
    });
    costs.live_cpu_us = values(&kinds, |live| Some(quantile(&live.cpu_us, 0.5)));
    costs.killed_s = values(&kinds, |live| Some(quantile(&live.killed_s, 0.5)));
}

fn values([wasm, python]: &[LiveKind; 2], of: impl Fn(&LiveKind) -> Option<f64>) -> KindValues {
    let measured = |live| of(live).filter(|value| value.is_finite());
    KindValues { native: None, wasm: measured(wasm), python: measured(python) }
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
        base: Some(Twin::Rust.to_string()),
        series: series.collect(),
    }
}

impl LiveKind {
    /// Runs `count` lambdas. A single one is also measured by its CPU time, and killed.
    fn run(&mut self, kind: Twin, count: usize, statuses: usize) {
        let folder = format!("examples/imu-fft/{}", kind.folder());
        let copies: Vec<_> = (0..count)
            .map(|index| LambdaCopy::named(&folder, &format!("imu-fft-{index}")))
            .collect();
        let folders: Vec<&Path> = copies.iter().map(LambdaCopy::path).collect();
        let (out, drive) = (TempFolder::new(), sample_drive());
        let drive = drive.to_str().expect("a plain name");
        let started = run_all(&folders, out.path(), &["--no-record", "--all", "--drive", drive]);
        if count == 1 {
            self.cpu_per_wake(&started, statuses);
        } else {
            until_all_warm(&started, count);
        }
        let processes = LiveProcesses::of(&started);
        let memory = processes.shims.iter().chain(&processes.lambdas).map(|pid| pss_mib(*pid));
        let megabytes = memory.sum::<f64>() * f64::from(1 << 20) / 1e6;
        self.memory.push((count, megabytes));
        if let ([lambda], 1) = (&processes.lambdas[..], count) {
            self.killed_s.push(until_replaced(*lambda, out.path()));
        }
        started.signal("INT");
        started.finish();
    }

    /// Adds the CPU time per wake between statuses.
    fn cpu_per_wake(&mut self, started: &RunningProgram, statuses: usize) {
        let mut before = started.until_live("the first spectra", |live| live.wakes >= WARM_UP);
        for _ in 1..statuses {
            let live = started.until_live("a status", |_| true);
            let wakes = (live.wakes - before.wakes) as f64;
            self.cpu_us.push(1e6 * (live.cpu_s - before.cpu_s) / wakes);
            before = live;
        }
    }

    fn memory_of(&self, count: usize) -> f64 {
        let of_count = self.memory.iter().filter(|(lambdas, _)| *lambdas == count);
        quantile(&of_count.map(|(_, megabytes)| *megabytes).collect::<Vec<_>>(), 0.5)
    }
}

fn until_all_warm(started: &RunningProgram, count: usize) {
    let mut warm = Vec::new();
    started.until_named("the first spectra of all", |name, report| {
        if let Report::Live(live) = report
            && live.wakes >= WARM_UP
            && !warm.contains(&name)
        {
            warm.push(name);
        }
        (warm.len() == count).then_some(())
    });
}

/// Kills a lambda's process; returns the time until the end of its next wake, in s.
fn until_replaced(lambda: u32, out: &Path) -> f64 {
    let clock = Clock::from_time_of_day();
    let pid = i32::try_from(lambda).ok().and_then(Pid::from_raw).expect("a process id");
    let killed_ns = clock.now();
    kill_process(pid, Signal::KILL).expect("the process runs");
    let deadline = Instant::now() + PATIENCE;
    loop {
        let text = std::fs::read_to_string(out.join("decisions.jsonl")).unwrap_or_default();
        // The last line may be incomplete.
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let newest: Option<Decision> =
            whole.lines().next_back().and_then(|line| serde_json::from_str(line).ok());
        // The process may have been within a wake.
        if newest.is_some_and(|newest| newest.at_ns > killed_ns + 100_000_000) {
            let decisions =
                whole.lines().filter_map(|line| serde_json::from_str::<Decision>(line).ok());
            let mut after = decisions.filter(|decision| decision.at_ns > killed_ns);
            let first = after.next().expect("there is a newer one");
            return (first.at_ns - killed_ns) as f64 / 1e9 + first.run_ns as f64 / 1e9;
        }
        assert!(Instant::now() < deadline, "a killed lambda is not replaced");
        sleep(Duration::from_millis(20));
    }
}
