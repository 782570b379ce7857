//! One side of a comparison: it is started, fed for one turn, and ended.

use std::collections::BTreeMap;
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_bench_results::{Figure, PowerMeter};
use gleaner_protocol::LiveStatus;
use gleaner_protocol::inference::InferenceReport;
use gleaner_tests::live::{PATIENCE, RunningProgram, cpu_ns, descendants, play, run};
use gleaner_tests::{LambdaCopy, TempFolder};

use super::ANSWERS;
use super::bare::BareReader;
use super::core_split::CoreSplit;
use super::node::NodeSide;
use super::workload::Workload;
use crate::answers::{RttAnswer, RttReceiver};
use crate::measure::{Twin, pss_mib};

/// Interval of reading the memory of a side. A process waits meanwhile, for less than 1 in 1,000
/// samples of an IMU at 100 Hz.
const MEMORY_INTERVAL: Duration = Duration::from_secs(4);

pub(super) enum Side {
    /// A reader that only answers.
    Bare,
    /// A lambda in `gleaner run`.
    Lambda(Box<LambdaSide>),
    /// A program without Gleaner.
    Node(NodeSide),
}

/// A lambda, and its status at the end of the last turn.
pub(super) struct LambdaSide {
    /// Name among the lambdas of its workload.
    pub(super) name: String,
    pub(super) kind: Twin,
    pub(super) lambda: LambdaCopy,
    /// True if its topics are received with real-time priority.
    pub(super) real_time: bool,
    pub(super) last: Option<LiveStatus>,
}

/// The measurements of one turn.
pub(super) struct Turn {
    /// Round trips after the warm-up, in the order of their answers.
    pub(super) times_ms: Vec<f64>,
    /// Samples that were sent and answered, with those of the warm-up.
    pub(super) sent: u64,
    pub(super) answered: u64,
    /// Costs of all processes of the side; `None` for a part of the bench itself.
    pub(super) cpu_percent: Option<f64>,
    pub(super) memory_mb: Option<f64>,
    /// Memory over the measured time: seconds, and MB.
    pub(super) memory: Vec<[f64; 2]>,
    /// Power of the whole machine: what was measured, and W.
    pub(super) power_w: Vec<(String, f64)>,
    /// Facts about the side.
    pub(super) facts: BTreeMap<String, String>,
}

enum RunningSide {
    Bare(BareReader),
    Lambda(RunningProgram, TempFolder),
    Node(RunningProgram),
}

impl Side {
    /// Name of the bare reader.
    pub(super) const BARE: &'static str = "bare reader";

    pub(super) fn name(&self) -> String {
        match self {
            Self::Bare => Self::BARE.to_owned(),
            Self::Lambda(side) => format!("lambda, {}", side.name),
            Self::Node(side) => side.name(),
        }
    }

    /// Runs one turn; `seconds` are those of the warm-up and of the measured time.
    ///
    /// # Errors
    ///
    /// The reason why it cannot run here.
    pub(super) fn turn(
        &mut self,
        workload: Workload,
        answers: &RttReceiver,
        (split, meter): (&CoreSplit, &PowerMeter),
        [warm_up, measured]: [u32; 2],
    ) -> Result<Turn, String> {
        let (running, mut facts) = split.for_side(|| self.start(workload))?;
        answers.take();
        let player = workload.player(matches!(self, Self::Bare), warm_up + measured);
        let mut arguments = vec!["--stamp", "monotonic", "--wait", "1"];
        arguments.extend(player.iter().map(String::as_str));
        let player = play(&arguments);
        let mut received = first(answers, &self.name());
        sleep(Duration::from_secs(warm_up.into()));
        let (before, began) = (running.cpu_ns(), Instant::now());
        let mut memory: Vec<[f64; 2]> = Vec::new();
        let measured = Duration::from_secs_f64(0.9 * f64::from(measured));
        let power_w = meter.watch(measured, |elapsed| {
            let due = MEMORY_INTERVAL * memory.len() as u32;
            if elapsed >= due {
                memory.extend(running.memory_mb().map(|mb| [due.as_secs_f64(), mb]));
            }
        });
        let cpu = running.cpu_ns().zip(before).map(|(after, before)| after.saturating_sub(before));
        let span = began.elapsed();
        let memory_mb = memory.last().map(|[_, mb]| *mb);
        if workload.is_looped() {
            player.signal("INT");
        }
        let played = player.finish();
        let sent = played.sent()[workload.event().0];
        // The last answers may still be on their way.
        sleep(Duration::from_millis(500));
        received.extend(answers.take());
        self.end(running, &mut facts);
        let stamp = |answer: &RttAnswer| answer.at_ns - answer.ns as i64;
        let from = stamp(&received[0]) + i64::from(warm_up) * 1_000_000_000;
        let counted = received.iter().filter(|answer| stamp(answer) >= from);
        Ok(Turn {
            times_ms: counted.map(|answer| answer.ns / 1e6).collect(),
            sent,
            answered: received.len() as u64,
            cpu_percent: cpu.map(|cpu| 100.0 * cpu as f64 / span.as_nanos() as f64),
            memory_mb,
            memory,
            power_w,
            facts,
        })
    }

    fn start(&self, workload: Workload) -> Result<(RunningSide, BTreeMap<String, String>), String> {
        let (topic, type_name) = workload.event();
        let fact = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        match self {
            Self::Bare => {
                let reader = BareReader::start(topic, type_name, ANSWERS);
                Ok((RunningSide::Bare(reader), [fact("stack", "RustDDS, in one thread")].into()))
            }
            Self::Lambda(side) => {
                let out = TempFolder::new();
                let mut args = vec!["--no-record", "--rtt", ANSWERS];
                args.extend(side.real_time.then_some("--real-time"));
                let started = run(side.lambda.path(), out.path(), &args);
                started.until_ready();
                if side.real_time {
                    let has_network = |live: &LiveStatus| live.network.buffer_granted > 0;
                    let live = started.until_live("a status of the network", has_network);
                    if !live.network.real_time {
                        return Err("real-time priority is not permitted here".to_owned());
                    }
                }
                let stack = fact("stack", "RustDDS, in gleaner-ingress");
                Ok((RunningSide::Lambda(started, out), [stack].into()))
            }
            Self::Node(side) => {
                let (started, facts) = side.start(workload)?;
                Ok((RunningSide::Node(started), facts))
            }
        }
    }

    /// Ends a side, and adds what it states at its end.
    fn end(&mut self, running: RunningSide, facts: &mut BTreeMap<String, String>) {
        match running {
            RunningSide::Bare(reader) => reader.stop(),
            RunningSide::Lambda(started, _out) => {
                let finished = started.interrupt();
                let runtime = finished.lines.iter().find_map(|line| model_runtime(line));
                facts.extend(runtime.map(|runtime| ("model".to_owned(), runtime)));
                let live = finished.ended();
                let granted = live.network.buffer_granted;
                facts.insert("socket buffer, B".to_owned(), granted.to_string());
                if let Self::Lambda(side) = self {
                    side.last = Some(live);
                }
            }
            RunningSide::Node(started) => {
                let finished = started.interrupt();
                assert!(finished.status.success(), "{}", finished.stderr);
            }
        }
    }

    /// Adds the times of the stages of a lambda, in its last turn. Goals are for small samples: an
    /// image is copied into its slot on the way.
    pub(super) fn stages(&self, workload: Workload, group: &str, figures: &mut Vec<Figure>) {
        let Self::Lambda(side) = self else { return };
        let Some(live) = &side.last else { return };
        let goals = match side.kind {
            Twin::Rust => [20.0, 100.0],
            Twin::Python => [30.0, 150.0],
        };
        for (what, stats, has_goal) in [
            ("sample received to lambda entered", live.wake_latency, true),
            ("in the lambda", live.run_time, false),
            ("lambda returned to decision sent", live.decision_latency, true),
        ] {
            let Some(stats) = stats else { continue };
            for (share, ns, goal) in
                [("p50", stats.p50_ns, goals[0]), ("p99", stats.p99_ns, goals[1])]
            {
                let name = format!("{group}, {}: {what}, {share}", side.name);
                let us = [ns as f64 / 1e3];
                figures.push(if has_goal && !workload.is_of_images() {
                    Figure::at_most(&name, "us", goal, &us)
                } else {
                    Figure::without_goal(&name, "us", &us)
                });
            }
        }
    }
}

impl RunningSide {
    /// Returns the processes of the side; none for a part of the bench itself.
    fn processes(&self) -> Vec<u32> {
        match self {
            Self::Bare(_) => Vec::new(),
            Self::Lambda(started, _) => {
                // The command itself only waits, and prints the status once a second.
                descendants(started.pid(), "")
            }
            Self::Node(started) => vec![started.pid()],
        }
    }

    fn cpu_ns(&self) -> Option<u64> {
        let processes = self.processes();
        (!processes.is_empty()).then(|| processes.into_iter().map(cpu_ns).sum())
    }

    fn memory_mb(&self) -> Option<f64> {
        let processes = self.processes();
        let mib = (!processes.is_empty()).then(|| processes.into_iter().map(pss_mib).sum::<f64>());
        mib.filter(|mib| mib.is_finite()).map(|mib| mib * f64::from(1 << 20) / 1e6)
    }
}

/// Returns what ran the model of a lambda, if a line is the last report of its process.
fn model_runtime(line: &str) -> Option<String> {
    match serde_json::from_str(line) {
        Ok(InferenceReport::Ended(status)) => Some(status.models.first()?.runtime.clone()),
        _ => None,
    }
}

/// Waits for the first answers of a side.
fn first(answers: &RttReceiver, side: &str) -> Vec<RttAnswer> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let received = answers.take();
        if !received.is_empty() {
            return received;
        }
        assert!(Instant::now() < deadline, "{side}: no answer arrives");
        sleep(Duration::from_millis(20));
    }
}
