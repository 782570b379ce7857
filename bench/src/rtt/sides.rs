//! One side of a comparison: it is started, fed for one turn, and ended.

use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::symlink;
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_bench::{EnergyMeter, Figure, PartEnergy, Throttling};
use gleaner_messages::transport::Clock;
use gleaner_protocol::LiveStatus;
use gleaner_protocol::inference::InferenceReport;
use gleaner_tests::live::{PATIENCE, RunningProgram, cpu_ns, descendants, play, run_by};
use gleaner_tests::{LambdaCopy, TempFolder, program};

use super::ANSWERS;
use super::core_split::CoreSplit;
use super::node::{NodeKind, NodeSide};
use super::workload::Workload;
use crate::answers::{RttAnswer, RttReceiver};
use crate::measure::{Twin, pss_mib};

/// Interval of reading the memory of a side, and the state of the machine. A process waits
/// meanwhile, for less than 1 in 1,000 samples of an IMU at 100 Hz.
const LOOK_INTERVAL: Duration = Duration::from_secs(4);

const NO_CPU: &str = "CPU: skipped: a process started or ended, or its time cannot be read";
const NO_MEMORY: &str = "memory: skipped: the processes or their `smaps_rollup` cannot be read";

pub(super) enum Side {
    /// A lambda in `gleaner run`.
    Lambda(LambdaSide),
    /// A program without Gleaner.
    Node(NodeSide),
}

/// A lambda.
pub(super) struct LambdaSide {
    pub(super) kind: Twin,
    pub(super) mode: LambdaMode,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum LambdaMode {
    Usual,
    /// The lambda computes by kernels of the SDK what the host does otherwise.
    Kernel,
    /// Its topics are received with real-time priority.
    RealTime,
    /// The component has neither fuel nor epochs.
    Unchecked,
}

/// The conditions of all turns of a comparison.
pub(super) struct TurnConditions<'a> {
    pub(super) workload: Workload,
    pub(super) answers: &'a RttReceiver,
    pub(super) split: &'a CoreSplit,
    pub(super) meter: &'a EnergyMeter,
    /// Energy while nothing ran.
    pub(super) idle: &'a [PartEnergy],
    /// Lengths of the warm-up and of the measured time.
    pub(super) seconds: [u32; 2],
}

/// The measurements of one turn.
#[derive(Default)]
pub(super) struct Turn {
    /// All answers, in the order of their arrival.
    pub(super) answers: Vec<RttAnswer>,
    /// Stamp of the first sample after the warm-up.
    from_ns: i64,
    /// Samples that were sent, with those of the warm-up.
    pub(super) sent: u64,
    /// Costs by name and unit, of all processes of the side and of the machine. What is unknown is
    /// absent, never 0.
    pub(super) costs: Vec<(String, f64)>,
    /// Reasons why some costs are absent.
    pub(super) absent: Vec<&'static str>,
    /// Memory over the measured time: seconds, and MB.
    pub(super) memory: Vec<[f64; 2]>,
    /// Facts about the side.
    pub(super) facts: BTreeMap<String, String>,
    /// Of a lambda, at its end.
    pub(super) live: Option<Box<LiveStatus>>,
    /// Reasons why the turn is invalid.
    pub(super) invalid: BTreeSet<String>,
}

struct RunningSide {
    started: RunningProgram,
    is_lambda: bool,
    /// Of a lambda, for as long as it runs.
    _files: Option<(LambdaCopy, TempFolder)>,
}

impl Turn {
    /// Returns the answers to samples after the warm-up.
    pub(super) fn counted(&self) -> impl Iterator<Item = &RttAnswer> {
        self.answers.iter().filter(|answer| answer.stamp_ns() >= self.from_ns)
    }

    /// Returns the number of faults of a lambda, of wakes skipped after them, and of restarts.
    pub(super) fn faults(&self) -> u64 {
        let live = self.live.as_deref();
        live.map_or(0, |live| live.faults + live.backed_off + u64::from(live.restarts))
    }
}

impl LambdaSide {
    fn name(&self) -> String {
        match self.mode {
            LambdaMode::Usual => self.kind.to_string(),
            LambdaMode::Kernel => format!("{}, SDK kernel", self.kind),
            LambdaMode::RealTime => format!("{}, in real time", self.kind),
            LambdaMode::Unchecked => format!("{} without checks", self.kind),
        }
    }

    fn start(&self, workload: Workload) -> Result<RunningSide, String> {
        let copy = match self.mode {
            LambdaMode::Kernel => Workload::kernel_lambda(),
            _ => workload.lambda(self.kind),
        };
        let (folder, mut gleaner) = (TempFolder::new(), Command::new(program("gleaner")));
        if self.mode == LambdaMode::Unchecked {
            // This program acts as the runtime under its name; see `main`.
            let this = std::env::current_exe().expect("a program has a path");
            symlink(this, folder.path().join("gleaner-runtime")).expect("the folder is new");
            gleaner.env("GLEANER_HOME", folder.path());
        }
        let mut args = vec!["--no-record", "--rtt", ANSWERS];
        args.extend(workload.config().iter().flat_map(|value| ["--set", value]));
        args.extend((self.mode == LambdaMode::RealTime).then_some("--real-time"));
        let started = run_by(gleaner, &[copy.path()], &folder.path().join("out"), &args);
        started.until_ready();
        if self.mode == LambdaMode::RealTime {
            let has_network = |live: &LiveStatus| live.network.buffer_granted > 0;
            let live = started.until_live("a status of the network", has_network);
            if !live.network.real_time {
                return Err("real-time priority is not permitted here".to_owned());
            }
        }
        Ok(RunningSide { started, is_lambda: true, _files: Some((copy, folder)) })
    }
}

impl Side {
    pub(super) fn name(&self) -> String {
        match self {
            Self::Lambda(side) => format!("lambda, {}", side.name()),
            Self::Node(side) => side.name(),
        }
    }

    /// Returns whether it only answers.
    pub(super) fn is_bare(&self) -> bool {
        matches!(self, Self::Node(NodeSide { kind: NodeKind::Bare, .. }))
    }

    pub(super) fn is_lambda(&self) -> bool {
        matches!(self, Self::Lambda(_))
    }

    fn is_unchecked(&self) -> bool {
        matches!(self, Self::Lambda(LambdaSide { mode: LambdaMode::Unchecked, .. }))
    }

    /// Runs one turn.
    ///
    /// # Errors
    ///
    /// The reason why it cannot run here.
    ///
    /// # Panics
    ///
    /// With its standard error, if it fails.
    pub(super) fn turn(&self, conditions: &TurnConditions<'_>) -> Result<Turn, String> {
        let &TurnConditions { workload, answers, split, seconds, .. } = conditions;
        let [warm_up, measured] = seconds;
        let before = Throttling::now();
        let (running, facts) = split.for_side(|| self.start(workload))?;
        answers.take();
        let player = workload.player(self.is_bare(), warm_up + measured);
        let mut arguments = vec!["--stamp", "monotonic", "--wait", "1"];
        arguments.extend(player.iter().map(String::as_str));
        let player = play(&arguments);
        let mut turn = Turn { answers: running.first(answers), facts, ..Turn::default() };
        turn.from_ns = turn.answers[0].stamp_ns() + i64::from(warm_up) * 1_000_000_000;
        sleep(Duration::from_secs(warm_up.into()));
        // A player that ends by itself may do so a little earlier.
        let share = if workload.is_looped() { 1.0 } else { 0.9 };
        let measured = Duration::from_secs_f64(share * f64::from(measured));
        // Without checks, the process also has the compiler of its component.
        running.measure(measured, conditions, !self.is_unchecked(), &mut turn);
        if workload.is_looped() {
            player.signal("INT");
        }
        turn.sent = player.finish().sent()[workload.event().0];
        // The last answers may still be on their way.
        sleep(Duration::from_millis(500));
        turn.answers.extend(answers.take());
        turn.invalid.extend(Throttling::now().since(&before));
        turn.live = self.end(running, &mut turn.facts);
        Ok(turn)
    }

    fn start(&self, workload: Workload) -> Result<(RunningSide, BTreeMap<String, String>), String> {
        match self {
            Self::Lambda(side) => {
                let fact = |name: &str, value: &str| (name.to_owned(), value.to_owned());
                let stack = fact("stack", "RustDDS, in gleaner-ingress");
                let memory = fact("memory", "not measured: the process has the compiler in it");
                let facts = [stack].into_iter().chain(self.is_unchecked().then_some(memory));
                Ok((side.start(workload)?, facts.collect()))
            }
            Self::Node(side) => {
                let (started, facts) = side.start(workload)?;
                Ok((RunningSide { started, is_lambda: false, _files: None }, facts))
            }
        }
    }

    /// Ends a side, and adds what it states at its end. Returns the last status of a lambda.
    fn end(
        &self,
        running: RunningSide,
        facts: &mut BTreeMap<String, String>,
    ) -> Option<Box<LiveStatus>> {
        let finished = running.started.interrupt();
        match self {
            Self::Lambda(_) => {
                let runtime = finished.lines.iter().find_map(|line| model_runtime(line));
                facts.extend(runtime.map(|runtime| ("model".to_owned(), runtime)));
                let live = finished.ended();
                let granted = live.network.buffer_granted;
                facts.insert("socket buffer, B".to_owned(), granted.to_string());
                Some(Box::new(live))
            }
            Self::Node(_) => {
                assert!(finished.status.success(), "{}", finished.stderr);
                None
            }
        }
    }

    /// Adds the times of the stages of a lambda, in its last turn. Goals are for small samples, as
    /// an image is copied into its slot on the way, and for a valid series.
    pub(super) fn stages(
        &self,
        workload: Workload,
        group: &str,
        (last, is_valid): (&Turn, bool),
        figures: &mut Vec<Figure>,
    ) {
        let Self::Lambda(side) = self else { return };
        let Some(live) = &last.live else { return };
        let goals = match side.kind {
            Twin::Rust => [20.0, 100.0],
            Twin::Python => [30.0, 150.0],
        };
        let has_goals = is_valid && !workload.is_of_images() && !self.is_unchecked();
        for (what, stats, has_goal) in [
            ("sample received to lambda entered", live.wake_latency, has_goals),
            ("in the lambda", live.run_time, false),
            ("lambda returned to decision sent", live.decision_latency, has_goals),
        ] {
            let Some(stats) = stats else { continue };
            for (share, ns, goal) in
                [("p50", stats.p50_ns, goals[0]), ("p99", stats.p99_ns, goals[1])]
            {
                let name = format!("{group}, {}: {what}, {share}", side.name());
                let us = [ns as f64 / 1e3];
                figures.push(if has_goal {
                    Figure::at_most(&name, "us", goal, &us)
                } else {
                    Figure::without_goal(&name, "us", &us)
                });
            }
        }
    }
}

impl RunningSide {
    /// Waits for the first answers.
    fn first(&self, answers: &RttReceiver) -> Vec<RttAnswer> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let received = answers.take();
            if !received.is_empty() {
                return received;
            }
            let is_late = Instant::now() > deadline;
            assert!(!is_late, "no answer arrives; stderr:\n{}", self.started.stderr());
            sleep(Duration::from_millis(20));
        }
    }

    /// Measures for `time`, and adds the costs, the answers and active cooling to a turn.
    fn measure(
        &self,
        time: Duration,
        conditions: &TurnConditions<'_>,
        reads_memory: bool,
        turn: &mut Turn,
    ) {
        let (clock, cpu_before) = (Clock::new(0), self.cpu_ns());
        let began_ns = clock.now();
        let mut looks = 0;
        let energy = conditions.meter.watch(time, |elapsed| {
            let due = LOOK_INTERVAL * looks;
            if elapsed < due {
                return;
            }
            looks += 1;
            let state = Throttling::now();
            turn.invalid.extend(state.since(&state));
            if reads_memory {
                turn.memory.push([due.as_secs_f64(), self.memory_mb()]);
            }
        });
        let cpu_ns = used(&cpu_before, &self.cpu_ns());
        let (ended_ns, after) = (clock.now(), Throttling::now());
        turn.invalid.extend(after.since(&after));
        turn.answers.extend(conditions.answers.take());
        let answers = turn.answers.iter();
        let in_span = answers.filter(|it| (began_ns..ended_ns).contains(&it.arrived_ns));
        let (span_s, wakes) = ((ended_ns - began_ns) as f64 / 1e9, in_span.count());
        let last_mb = turn.memory.last().map(|[_, mb]| *mb);
        for (name, value) in [
            ("CPU, % of a core", cpu_ns.map(|cpu_ns| cpu_ns as f64 / 1e7 / span_s)),
            ("memory (PSS), MB", last_mb.filter(|mb| mb.is_finite())),
            ("temperature, °C", after.temperature),
            ("clock, MHz", after.clock_mhz),
        ] {
            turn.costs.extend(value.map(|value| (name.to_owned(), value)));
        }
        let power = energy.iter().flat_map(|part| power(part, conditions.idle, span_s, wakes));
        turn.costs.extend(power);
        turn.absent.extend(cpu_ns.is_none().then_some(NO_CPU));
        turn.absent.extend(last_mb.is_some_and(f64::is_nan).then_some(NO_MEMORY));
    }

    /// Returns all its processes, with the command; none if those of a lambda cannot be listed.
    fn processes(&self) -> Vec<u32> {
        let mut processes = vec![self.started.pid()];
        if self.is_lambda {
            processes.extend(descendants(self.started.pid(), ""));
        }
        if self.is_lambda && processes.len() == 1 { Vec::new() } else { processes }
    }

    /// Returns the CPU time of each process so far.
    fn cpu_ns(&self) -> BTreeMap<u32, u64> {
        self.processes().into_iter().map(|pid| (pid, cpu_ns(pid))).collect()
    }

    /// NaN if it is unknown.
    fn memory_mb(&self) -> f64 {
        let mib = self.processes().into_iter().map(pss_mib).reduce(|sum, mib| sum + mib);
        mib.map_or(f64::NAN, |mib| mib * f64::from(1 << 20) / 1e6)
    }
}

/// Returns the CPU time between two readings; `None` if it was not counted, or not of each process.
fn used(before: &BTreeMap<u32, u64>, after: &BTreeMap<u32, u64>) -> Option<u64> {
    let each = before.iter().map(|(pid, before)| after.get(pid)?.checked_sub(*before));
    let used = each.sum::<Option<u64>>()?;
    (before.len() == after.len() && used > 0).then_some(used)
}

/// Returns the power of a part of the machine and, where it was measured while nothing ran, what is
/// above that. A side made `wakes` answers in `span_s` seconds.
fn power(part: &PartEnergy, idle: &[PartEnergy], span_s: f64, wakes: usize) -> Vec<(String, f64)> {
    let PartEnergy { part: name, watts, .. } = part;
    let mut costs = vec![(format!("power, {name}, W"), *watts)];
    if let Some(idle) = idle.iter().find(|idle| idle.part == *name) {
        let above = watts - idle.watts;
        costs.push((format!("power above idle, {name}, W"), above));
        let per_wake = 1e3 * above * span_s / wakes as f64;
        costs.push((format!("energy per wake above idle, {name}, mJ"), per_wake));
    }
    costs
}

/// Returns what ran the model of a lambda, if a line is the last report of its process.
fn model_runtime(line: &str) -> Option<String> {
    match serde_json::from_str(line) {
        Ok(InferenceReport::Ended(status)) => Some(status.models.first()?.runtime.clone()),
        _ => None,
    }
}
