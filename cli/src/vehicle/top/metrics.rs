//! Figures of a vehicle: rates by the growth of counts between two reports of a process, and sums.

use gleaner_base::visible;
use gleaner_protocol::LiveStatus;
use gleaner_protocol::supervision::{LambdaPhase, ProcessStatus, SupervisorStatus};
use gleaner_protocol::vehicle_api::{Capacity, DeploymentStatus, TrustStatus, VehicleStatus};
use gleaner_report::format::counted;
use serde::Serialize;

use super::super::status;
use crate::render::live_losses;

/// The figures of a vehicle: an object of `gleaner top --json`.
#[derive(Debug, Serialize)]
pub(super) struct VehicleMetrics {
    pub(super) vehicle: String,
    /// Age of a status of a cloud, in s.
    pub(super) age_s: Option<f64>,
    pub(super) trust: Option<TrustStatus>,
    pub(super) capacity: Vec<Capacity>,
    pub(super) orchestrator: ProgramMetrics,
    pub(super) supervisor: Option<ProgramMetrics>,
    pub(super) services: Vec<ServiceFigures>,
    pub(super) lambdas: Vec<LambdaMetrics>,
}

#[derive(Debug, Serialize)]
pub(super) struct ProgramMetrics {
    /// CPU time in percent of a core.
    pub(super) cpu_percent: Option<f64>,
    pub(super) rss_bytes: u64,
}

/// A process that all lambdas share.
#[derive(Debug, Serialize)]
pub(super) struct ServiceFigures {
    pub(super) name: &'static str,
    pub(super) is_ready: bool,
    pub(super) restarts: u32,
    pub(super) rss_bytes: Option<u64>,
}

/// The figures of a lambda. Those of a process are absent before its first report.
#[derive(Debug, Serialize)]
pub(super) struct LambdaMetrics {
    pub(super) id: String,
    pub(super) lambda: String,
    pub(super) version: String,
    pub(super) state: &'static str,
    pub(super) restarts: Option<u32>,
    pub(super) wakes: Option<u64>,
    pub(super) wakes_per_s: Option<f64>,
    pub(super) wake_p50_ns: Option<u64>,
    pub(super) wake_p99_ns: Option<u64>,
    pub(super) run_p99_ns: Option<u64>,
    /// CPU time in percent of a core.
    pub(super) cpu_percent: Option<f64>,
    pub(super) rss_bytes: Option<u64>,
    pub(super) triggers: Option<u64>,
    pub(super) faults: Option<u64>,
    pub(super) losses: Option<u64>,
    /// Clips with its windows, since the start of the supervisor.
    pub(super) clips: Option<u64>,
    pub(super) clip_bytes: Option<u64>,
    /// The reasons why it does not run as wanted.
    pub(super) reasons: Vec<String>,
}

impl VehicleMetrics {
    /// Computes the figures of a status, with rates by `earlier` ones, the newest first.
    pub(super) fn of<'s>(
        now: &VehicleStatus,
        earlier: impl Iterator<Item = &'s VehicleStatus> + Clone,
    ) -> Self {
        let orchestrator = |it: &VehicleStatus| {
            let program = &it.orchestrator;
            Some(Reading { process: program.pid, up_s: program.up_s, count: program.cpu_s })
        };
        let supervisor = |it: &VehicleStatus| {
            let it = it.supervisor.as_ref()?;
            Some(Reading { process: (), up_s: it.up_s, count: it.cpu_s })
        };
        let cpu_percent = percent(growth(orchestrator, now, earlier.clone()));
        Self {
            vehicle: now.vehicle.clone(),
            age_s: now.age_s,
            trust: now.trust.clone(),
            capacity: now.capacity.clone(),
            orchestrator: ProgramMetrics { cpu_percent, rss_bytes: now.orchestrator.rss_bytes },
            supervisor: now.supervisor.as_ref().map(|status| ProgramMetrics {
                cpu_percent: percent(growth(supervisor, now, earlier.clone())),
                rss_bytes: status.rss_bytes,
            }),
            services: now.supervisor.as_ref().map(services).unwrap_or_default(),
            lambdas: (now.deployments.iter())
                .map(|deployment| LambdaMetrics::of(deployment, now, earlier.clone()))
                .collect(),
        }
    }

    /// Returns whether all lambdas that run have rates.
    pub(super) fn are_complete(&self) -> bool {
        let lacks = |it: &LambdaMetrics| it.wakes.is_some() && it.cpu_percent.is_none();
        let runs = |it: &&LambdaMetrics| ["running", "on probation"].contains(&it.state);
        !self.lambdas.iter().filter(runs).any(lacks)
    }
}

impl LambdaMetrics {
    fn of<'s>(
        deployment: &DeploymentStatus,
        now: &VehicleStatus,
        earlier: impl Iterator<Item = &'s VehicleStatus> + Clone,
    ) -> Self {
        let id = &*deployment.id;
        let lambda = deployment.status.as_ref();
        let live = lambda.and_then(|lambda| lambda.live.as_deref());
        let clips = now
            .supervisor
            .as_ref()
            .map(|it| it.clips_by_lambda.get(&deployment.lambda).copied().unwrap_or_default());
        let wakes = |it: &VehicleStatus| reading(it, id, |live| live.wakes as f64);
        let cpu = |it: &VehicleStatus| reading(it, id, |live| live.cpu_s);
        Self {
            id: deployment.id.clone(),
            lambda: deployment.lambda.clone(),
            version: status::version(deployment),
            state: status::state(deployment),
            restarts: lambda.map(|lambda| lambda.restarts),
            wakes: live.map(|live| live.wakes),
            wakes_per_s: growth(wakes, now, earlier.clone()),
            wake_p50_ns: live.and_then(|live| Some(live.wake_latency?.p50_ns)),
            wake_p99_ns: live.and_then(|live| Some(live.wake_latency?.p99_ns)),
            run_p99_ns: live.and_then(|live| Some(live.run_time?.p99_ns)),
            cpu_percent: percent(growth(cpu, now, earlier)),
            rss_bytes: live.map(|live| live.rss_bytes),
            triggers: live.map(|live| live.triggers),
            faults: live.map(|live| live.faults),
            losses: live.map(|live| losses(live).iter().map(|(count, _)| count).sum()),
            clips: clips.map(|clips| clips.clips),
            clip_bytes: clips.map(|clips| clips.bytes),
            reasons: status::reasons(deployment),
        }
    }
}

/// Returns each count of lost data that is not 0, with its cause. Samples that newer ones replaced
/// in a ring do not count, and neither do losses of an unknown number.
pub(super) fn losses(live: &LiveStatus) -> Vec<(u64, String)> {
    let of_topics = live.topics.iter().flat_map(|topic| {
        let name = visible(&topic.topic);
        [
            (topic.lost.unwrap_or(0), "lost before their reception"),
            (topic.skipped, "woke nothing"),
            (topic.malformed, "malformed"),
            (topic.no_slot, "no free slot"),
            (topic.too_big, "larger than `max_size`"),
        ]
        .map(|(count, why)| (count, format!("{} of {name}, {why}", counted(count, "sample"))))
    });
    let others = live_losses(live);
    let others =
        others.map(|(count, thing, why)| (count, format!("{}, {why}", counted(count, thing))));
    of_topics.chain(others).filter(|(count, _)| *count > 0).collect()
}

/// A count of a process, `up_s` after its start.
struct Reading<P> {
    /// Equal for two readings of one process.
    process: P,
    up_s: f64,
    count: f64,
}

/// Returns the growth of a count in 1 s, since the newest of `earlier` statuses whose process had
/// reported before. `None` for another process: the growth of a restarted one is unknown.
fn growth<'s, P: PartialEq>(
    read: impl Fn(&VehicleStatus) -> Option<Reading<P>>,
    now: &VehicleStatus,
    earlier: impl Iterator<Item = &'s VehicleStatus>,
) -> Option<f64> {
    let now = read(now)?;
    let before = earlier
        .map_while(read)
        .take_while(|it| it.process == now.process && it.up_s <= now.up_s)
        .find(|it| it.up_s < now.up_s)?;
    let grown = now.count - before.count;
    (grown >= 0.0).then(|| grown / (now.up_s - before.up_s))
}

/// Reads a count of a lambda that runs.
fn reading(
    status: &VehicleStatus,
    id: &str,
    count: impl Fn(&LiveStatus) -> f64,
) -> Option<Reading<(u64, u32)>> {
    let deployment = status.deployments.iter().find(|deployment| deployment.id == id)?;
    let lambda = deployment.status.as_ref()?;
    let live = lambda.live.as_deref().filter(|_| lambda.phase == LambdaPhase::Running)?;
    let process = (lambda.attempt, lambda.restarts);
    Some(Reading { process, up_s: live.up_s, count: count(live) })
}

fn percent(growth: Option<f64>) -> Option<f64> {
    growth.map(|seconds| seconds * 100.0)
}

fn services(status: &SupervisorStatus) -> Vec<ServiceFigures> {
    fn service<S>(
        name: &'static str,
        status: &ProcessStatus<S>,
        rss_bytes: fn(&S) -> u64,
    ) -> ServiceFigures {
        let rss_bytes = status.last.as_deref().filter(|_| status.is_ready).map(rss_bytes);
        let ProcessStatus { is_ready, restarts, .. } = *status;
        ServiceFigures { name, is_ready, restarts, rss_bytes }
    }
    let ingress = service("ingress", &status.ingress, |it| it.rss_bytes);
    let recorder = status.recorder.as_ref().map(|it| service("recorder", it, |it| it.rss_bytes));
    let inference = status.inference.as_ref();
    let inference = inference.map(|it| service("inference", it, |it| it.resident_bytes));
    std::iter::once(ingress).chain(recorder).chain(inference).collect()
}
