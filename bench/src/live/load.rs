//! Load test: some lambdas in one `gleaner run`, while players publish. It measures what each
//! process receives and costs.

use std::collections::BTreeMap;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::Exit;
use gleaner_protocol::LiveStatus;
use gleaner_tests::live::{RunningProgram, cpu_ns, descendants, play, run_all};
use gleaner_tests::{LambdaCopy, TempFolder};

use crate::measure::Twin;
use gleaner_bench::{Figure, quantile};

/// Goals for the own memory (USS) of a lambda's process, in MB.
const OWN_MB: [(Twin, f64); 2] = [(Twin::Rust, 8.0), (Twin::Python, 25.0)];

/// A load: lambdas, players and a duration.
pub(super) struct Load<'a> {
    pub name: String,
    /// Lambdas of `bench/lambdas`, and how many of each.
    pub lambdas: &'a [(&'a str, usize)],
    /// Further IMU topics that each of them reads, as [`more_imu`] names them.
    pub more_topics: u32,
    pub kind: Twin,
    /// Arguments of each player.
    pub players: &'a [&'a [&'a str]],
    pub seconds: u32,
    /// True if packets are dropped, so that samples may be lost.
    pub is_lossy: bool,
}

/// The topic of a further IMU.
pub(super) fn more_imu(number: u32) -> String {
    format!("/imu/more_{number}")
}

pub(super) struct LoadCosts {
    /// Shares of a core, of the ingress and of all processes.
    pub(super) ingress_percent: f64,
    pub(super) all_percent: f64,
    /// Median wake latency.
    pub(super) wake_us: f64,
    /// CPU time of a lambda's process for each of its wakes.
    pub(super) wake_cpu_us: f64,
    /// Samples that were not received, in % of those that were sent.
    pub(super) missing_percent: f64,
}

/// The processes of a run, with shares of a core in % and own memory in MB.
struct Costs {
    ingress: Process,
    lambdas: Vec<Process>,
}

#[derive(Clone, Copy)]
struct Process {
    cpu_ns: u64,
    own_mb: f64,
}

impl Load<'_> {
    pub(super) fn measure(&self, figures: &mut Vec<Figure>) -> LoadCosts {
        let copies = self.lambdas.iter().flat_map(|(lambda, count)| {
            let folder = format!("bench/lambdas/{lambda}/{}", self.kind.folder());
            (0..*count).map(move |index| {
                LambdaCopy::changed_and_named(&folder, &format!("{lambda}-{index}"), |manifest| {
                    manifest + &more_inputs(self.more_topics)
                })
            })
        });
        let copies: Vec<LambdaCopy> = copies.collect();
        let folders: Vec<&Path> = copies.iter().map(LambdaCopy::path).collect();
        let out = TempFolder::new();
        let began = Instant::now();
        let started = run_all(&folders, out.path(), &["--no-record"]);
        // The only lambda of a run has no name in its reports.
        let names = if copies.len() == 1 {
            started.until_ready();
            Vec::new()
        } else {
            started.until_all_ready(copies.len())
        };
        let ready_ms = began.elapsed().as_secs_f64() * 1e3;
        let duration = self.seconds.to_string();
        let players: Vec<_> = self
            .players
            .iter()
            .map(|player| play(&[player, &["--wait", "1", "--duration", &duration][..]].concat()))
            .collect();
        // Warm-up, then two looks while the players publish.
        let part = Duration::from_secs_f64(f64::from(self.seconds) / 4.0);
        thread::sleep(part);
        let (first, at) = (Costs::of(&started), Instant::now());
        thread::sleep(2 * part);
        let (last, span) = (Costs::of(&started), at.elapsed());
        let mut sent = BTreeMap::new();
        for player in players {
            sent.extend(player.finish().sent());
        }
        // The last samples may be in transit.
        thread::sleep(Duration::from_millis(500));
        let finished = started.interrupt();
        // On a busy machine a wake may miss its deadline.
        let is_complete =
            finished.status.success() || finished.status.code() == Some(Exit::LambdaFaulted as i32);
        assert!(is_complete, "{}: {}", finished.status, finished.stderr);
        let ended: Vec<LiveStatus> = if copies.len() == 1 {
            vec![finished.ended()]
        } else {
            names.iter().map(|name| finished.ended_of(name).expect("it has ended")).collect()
        };
        let faults: u64 = ended.iter().map(|live| live.faults).sum();
        let name = format!("{}: wakes that ended in a fault", self.name);
        figures.push(Figure::at_most(&name, "", 0.0, &[faults as f64]));
        let missing_percent = self.receptions(&ended, &sent, figures);
        let wake_us = self.latencies(&ended, figures);
        let (ingress_percent, all_percent) = self.costs(&first, &last, span, ready_ms, figures);
        let wakes: u64 = ended.iter().map(|live| live.wakes).sum();
        let busy_s = (all_percent - ingress_percent) / 100.0 * f64::from(self.seconds);
        let wake_cpu_us = 1e6 * busy_s / wakes as f64;
        LoadCosts { ingress_percent, all_percent, wake_us, wake_cpu_us, missing_percent }
    }

    /// Adds what arrived of each topic, and what did not; returns the latter in % of all.
    fn receptions(
        &self,
        ended: &[LiveStatus],
        sent: &BTreeMap<String, u64>,
        figures: &mut Vec<Figure>,
    ) -> f64 {
        let (mut missing, mut refused) = (Vec::new(), Vec::new());
        for topic in ended.iter().flat_map(|live| &live.topics) {
            let counted = topic.no_slot + topic.too_big + topic.malformed;
            missing.push(sent[&topic.topic] as f64 - topic.received as f64);
            refused.push(topic.lost.map_or(f64::NAN, |lost| (lost + counted) as f64));
        }
        let network = &ended[0].network;
        let granted = network.buffer_granted >= network.buffer_requested;
        let buffer = network.buffer_granted as f64 / f64::from(1 << 20);
        let all: u64 = sent.values().sum();
        let name = format!(
            "{}: of {all} sent not received, with a socket buffer of {buffer:.0} MiB{}",
            self.name,
            if granted { "" } else { " (not granted)" }
        );
        figures.push(if granted && !self.is_lossy {
            Figure::at_most(&name, "samples", 0.0, &[missing.iter().sum()])
        } else {
            Figure::without_goal(&name, "samples", &[missing.iter().sum()])
        });
        self.add("counted as lost or refused", "samples", &refused, figures);
        let expected: u64 =
            ended.iter().flat_map(|live| &live.topics).map(|topic| sent[&topic.topic]).sum();
        100.0 * missing.iter().sum::<f64>() / expected as f64
    }

    /// Adds the costs; returns those of the ingress and of all processes, in % of a core.
    fn costs(
        &self,
        first: &Costs,
        last: &Costs,
        span: Duration,
        ready_ms: f64,
        figures: &mut Vec<Figure>,
    ) -> (f64, f64) {
        self.add("from the start of `gleaner run` to ready", "ms", &[ready_ms], figures);
        let lambdas = first.lambdas.iter().zip(&last.lambdas);
        let shares: Vec<f64> = lambdas.map(|(first, last)| first.share(last, span)).collect();
        let ingress = first.ingress.share(&last.ingress, span);
        self.add("ingress: share of a core", "%", &[ingress], figures);
        self.add("each lambda: share of a core", "%", &shares, figures);
        let all = ingress + shares.iter().sum::<f64>();
        self.add("all: share of a core", "%", &[all], figures);
        self.add("ingress: own memory", "MB", &[last.ingress.own_mb], figures);
        let own: Vec<f64> = last.lambdas.iter().map(|process| process.own_mb).collect();
        let goal = OWN_MB.iter().find(|(kind, _)| kind.folder() == self.kind.folder());
        let name = format!("{}: each lambda: own memory", self.name);
        figures.push(Figure::at_most(&name, "MB", goal.map_or(f64::NAN, |(_, mb)| *mb), &own));
        let processes = |costs: &Costs| [&[costs.ingress], &costs.lambdas[..]].concat();
        let growth = processes(first).into_iter().zip(processes(last));
        let growth: Vec<f64> =
            growth.map(|(first, last)| 100.0 * (last.own_mb / first.own_mb - 1.0)).collect();
        self.add("each process: growth of own memory", "%", &growth, figures);
        (ingress, all)
    }

    /// Adds the latencies; returns the median over the lambdas of their p50, in us.
    fn latencies(&self, ended: &[LiveStatus], figures: &mut Vec<Figure>) -> f64 {
        let stats: Vec<_> = ended.iter().filter_map(|live| live.wake_latency).collect();
        let us = |ns: fn(&gleaner_protocol::DurationStats) -> u64| {
            stats.iter().map(|stats| ns(stats) as f64 / 1e3).collect::<Vec<_>>()
        };
        let p50 = us(|stats| stats.p50_ns);
        self.add("wake latency, p50", "us", &p50, figures);
        self.add("wake latency, p99", "us", &us(|stats| stats.p99_ns), figures);
        quantile(&p50, 0.5)
    }

    fn add(&self, what: &str, unit: &str, values: &[f64], figures: &mut Vec<Figure>) {
        figures.push(Figure::without_goal(&format!("{}: {what}", self.name), unit, values));
    }
}

impl Costs {
    /// The costs so far of the processes of a run.
    fn of(started: &RunningProgram) -> Self {
        let LiveProcesses { ingress, lambdas, .. } = LiveProcesses::of(started);
        let ingress = ingress.map(Process::of).expect("a run has an ingress");
        Self { ingress, lambdas: lambdas.into_iter().map(Process::of).collect() }
    }
}

pub(crate) struct LiveProcesses {
    ingress: Option<u32>,
    pub(crate) shims: Vec<u32>,
    /// Those that run lambdas, in the same order each time.
    pub(crate) lambdas: Vec<u32>,
}

impl LiveProcesses {
    pub(crate) fn of(started: &RunningProgram) -> Self {
        let mut found = Self { ingress: None, shims: Vec::new(), lambdas: Vec::new() };
        for pid in descendants(started.pid(), "") {
            match read(pid, "comm").trim() {
                "gleaner-shim" => found.shims.push(pid),
                "gleaner-ingress" => found.ingress = Some(pid),
                _ => found.lambdas.push(pid),
            }
        }
        found.lambdas.sort_unstable();
        found
    }
}

impl Process {
    fn of(pid: u32) -> Self {
        let rollup = read(pid, "smaps_rollup");
        let private = rollup.lines().filter_map(|line| {
            let (name, kib) = line.split_once(':')?;
            let kib = kib.trim().strip_suffix(" kB")?.trim().parse::<f64>().ok()?;
            name.starts_with("Private_").then_some(kib)
        });
        let own_mb = private.sum::<f64>() * 1024.0 / 1e6;
        Self { cpu_ns: cpu_ns(pid), own_mb }
    }

    /// The share of a core that it took until `later`, `span` after this look, in %.
    fn share(&self, later: &Self, span: Duration) -> f64 {
        100.0 * later.cpu_ns.saturating_sub(self.cpu_ns) as f64 / span.as_nanos() as f64
    }
}

/// Inputs of further IMU topics, for a manifest.
fn more_inputs(count: u32) -> String {
    let input = |number| {
        format!(
            "\n[[input]]\nname = \"more_{number}\"\ntopic = \"{}\"\ntype = \
             \"sensor_msgs/msg/Imu\"\ndepth = 512\n",
            more_imu(number)
        )
    };
    (1..=count).map(input).collect()
}

fn read(pid: u32, name: &str) -> String {
    std::fs::read_to_string(format!("/proc/{pid}/{name}")).unwrap_or_default()
}
