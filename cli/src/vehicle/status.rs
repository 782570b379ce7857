//! `gleaner status`: what runs on a vehicle.

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{ByteSize, Exit, Failure, UtcTime, format_duration, in_one_line, visible};
use gleaner_protocol::LossOutcome;
use gleaner_protocol::link::RecorderStatus;
use gleaner_protocol::supervision::{LambdaPhase, LambdaStatus, ProcessStatus, SupervisorStatus};
use gleaner_protocol::vehicle_api::{
    Capacity, ClipsStatus, CloudStatus, DeploymentStatus, FailingStreams, StreamLoss, VehicleStatus,
};
use gleaner_report::format::{counted, grouped, size};

use super::client::VehicleClient;
use super::stream::gap_reason;
use crate::args::StatusArgs;
use crate::output::show;
use crate::render::{Paint, or_dash, table};

/// Age of a status from which a newer one is waited for, in s, and the longest wait.
const FRESH_S: f64 = 2.0;
const FRESH_WAIT: Duration = Duration::from_secs(2);

/// Shown without deployments.
pub(super) const NO_DEPLOYMENTS: &str =
    "nothing is deployed: `gleaner deploy --local DIR --key FILE`";

pub(crate) fn status(args: &StatusArgs) -> Result<Exit, Failure> {
    let client = VehicleClient::of(args)?;
    let mut status = client.status()?;
    // The first request lets a connected vehicle report at once.
    let (started, first) = (Instant::now(), status.age_s);
    while first.is_some_and(|age_s| age_s > FRESH_S) && started.elapsed() < FRESH_WAIT {
        thread::sleep(FRESH_WAIT / 10);
        status = client.status()?;
        if status.age_s < first {
            break;
        }
    }
    show(args.vehicle.json, &status, |status| text(status, Paint::of_stdout()))
}

pub(super) fn text(status: &VehicleStatus, paint: Paint) -> String {
    let (vehicle, labels) = (visible(&status.vehicle), labels_in_words(&status.labels));
    let mut text = format!("{} {}\n", paint.bold(&vehicle), paint.dim(&labels));
    if let Some(age) = age(status) {
        text += &format!("  as of {age}\n");
    }
    text += &format!("  clips are signed by {}\n", visible(&status.key));
    text += &match &status.trust {
        None => format!("  {}\n", paint.yellow("no trust root: `gleaner trust install FILE`")),
        Some(trust) if trust.is_expired => {
            format!("  {}\n", paint.yellow("the trust root has expired: install the next one"))
        }
        Some(trust) => format!("  trust root {}\n", trust.version),
    };
    text += &cloud_line(status.cloud.as_ref(), paint);
    for capacity in &status.capacity {
        text += &format!("  {} ({})\n", shared(capacity), visible(&capacity.source));
    }
    text += &status.supervisor.as_ref().map_or_else(
        || format!("  {}\n", paint.red("the supervisor does not run")),
        |supervisor| services(supervisor, paint),
    );
    let supervisor = status.supervisor.as_ref().map_or(0, |supervisor| supervisor.events_lost);
    for (program, lost) in [("orchestrator", status.events_lost), ("supervisor", supervisor)] {
        if lost > 0 {
            let lost = grouped(lost);
            let line = format!("events of the {program} lost: {lost}; check the disk and its room");
            text += &format!("  {}\n", paint.red(&line));
        }
    }
    for lost in &status.records_lost {
        text += &format!("  {}\n", paint.red(&records_lost(lost)));
    }
    if status.deployments.is_empty() {
        return text + &format!("\n{NO_DEPLOYMENTS}\n");
    }
    let head = [
        "id", "lambda", "runs", "state", "for", "restarts", "wakes", "triggers", "faults", "p99",
        "memory",
    ];
    text += "\n";
    text += &table(&head, status.deployments.iter().map(row), &[5, 6, 7, 8, 9, 10]);
    for deployment in &status.deployments {
        text += &format!("{}\n", paint.dim(&content(deployment)));
        for reason in reasons(deployment) {
            let line = format!("{}: {reason}", visible(&deployment.id));
            text += &format!("{}\n", paint.yellow(&line));
        }
    }
    text
}

fn services(supervisor: &SupervisorStatus, paint: Paint) -> String {
    let mut text = service("ingress", Some(&supervisor.ingress), paint);
    for health in supervisor.ingress.last.iter().map(|last| &last.health) {
        let unfiltered = health.network.iter().flat_map(|it| &it.unfiltered);
        let lacks = unfiltered.chain(&health.dead);
        text.extend(lacks.map(|why| format!("    {}\n", paint.yellow(&in_one_line(why)))));
    }
    text += &service("recorder", supervisor.recorder.as_ref(), paint);
    text += &losses(supervisor.recorder.as_ref(), paint);
    text += &service("inference", supervisor.inference.as_ref(), paint);
    for refused in &supervisor.refused_models {
        text += &format!("  {}\n", paint.red(&visible(refused)));
    }
    text
}

pub(crate) fn labels_in_words(labels: &BTreeMap<String, String>) -> String {
    let labels = labels.iter().map(|(name, value)| format!("{}={}", visible(name), visible(value)));
    labels.collect::<Vec<_>>().join(" ")
}

pub(crate) fn short(digest: &str) -> String {
    visible(&digest.chars().take(12).collect::<String>())
}

/// Formats the age of a status that a cloud has.
pub(super) fn age(status: &VehicleStatus) -> Option<String> {
    let age = Duration::try_from_secs_f64(status.age_s?.round()).ok()?;
    Some(format!("{} ago", format_duration(age)))
}

/// Returns the line of the connection to a cloud, if there is one.
pub(crate) fn cloud_line(status: Option<&CloudStatus>, paint: Paint) -> String {
    let Some(status) = status else { return String::new() };
    let state = match (&*status.state, &status.reason) {
        ("connected", _) => paint.green("connected"),
        ("refused", _) => paint.red("refused"),
        ("connecting", Some(_)) => paint.yellow("disconnected"),
        (state, _) => paint.yellow(&visible(state)),
    };
    let reason = status.reason.iter().map(|reason| format!(": {}", in_one_line(reason)));
    let help = status.help.iter().map(|help| format!(". {}", in_one_line(help)));
    let uncounted = match status.uncounted {
        0 => String::new(),
        count => format!(" ({} not counted)", counted(count, "stream")),
    };
    let unsent = match status.unsent {
        0 => "no unsent records".to_owned(),
        count => counted(count, "unsent record"),
    };
    format!(
        "  cloud {} {state} for {}{}; {unsent}{uncounted}, certificate until {}\n{}{}",
        visible(&status.address),
        seconds(status.since_s),
        reason.chain(help).collect::<String>(),
        UtcTime::of(status.certificate_expires.try_into().unwrap_or(i64::MAX)),
        failing_lines(&status.failing, paint),
        clips_line(&status.clips, paint),
    )
}

fn seconds(time: f64) -> String {
    format_duration(Duration::from_secs(time.max(0.0) as u64))
}

/// Returns a line for each cause of streams that cannot be sent.
fn failing_lines(failing: &[FailingStreams], paint: Paint) -> String {
    let line = |it: &FailingStreams| {
        let (streams, since, tried) =
            (counted(it.streams, "stream"), seconds(it.since_s), seconds(it.tried_s));
        let example = in_one_line(&it.example);
        let line = format!("{streams} not sent for {since}, tried {tried} ago: {example}");
        format!("    {}\n", paint.yellow(&line))
    };
    failing.iter().map(line).collect()
}

/// Returns the line of records that could not be written to a spool, or cannot be now.
fn records_lost(lost: &StreamLoss) -> String {
    let name = lost.stream.strip_prefix("lambdas/").unwrap_or(&lost.stream);
    let help = match &*lost.reason {
        "DiskFull" | "WriteFailed" => "; check the disk and its room",
        _ => "",
    };
    let counts = [
        ("lost", lost.records, "the last one at", lost.last_ns),
        ("waiting for the disk", lost.waiting, "since", lost.failing_ns),
    ];
    let counts = counts.into_iter().filter(|(_, count, ..)| *count > 0);
    let counts = counts.map(|(what, count, when, ns)| {
        let time = UtcTime::of(ns.div_euclid(1_000_000_000));
        format!("{what}: {}, {when} {time}", grouped(count))
    });
    let counts = counts.collect::<Vec<_>>().join("; ");
    format!("records of `{}` {counts}: {}{help}", visible(name), gap_reason(&lost.reason))
}

/// Returns the line of clips on their way to the cloud, if there are any.
fn clips_line(clips: &ClipsStatus, paint: Paint) -> String {
    let counts = [
        (clips.waiting.unwrap_or(0), "on their way to the cloud"),
        (clips.unreadable, "cannot be read"),
    ];
    let counts = counts.iter().filter(|(count, _)| *count > 0);
    let mut parts: Vec<_> = counts.map(|(count, what)| format!("{count} {what}")).collect();
    let unannounced = clips.unannounced_bytes.filter(|bytes| *bytes > 0).map(ByteSize::new);
    parts.extend(unannounced.map(|bytes| format!("{bytes} of their list not announced")));
    parts.extend(clips.paused.as_deref().map(in_one_line));
    parts.extend(clips.stuck.as_ref().map(|stuck| {
        let name = stuck.name.as_deref().map_or("the list".to_owned(), visible);
        let (attempts, since) = (stuck.attempts, seconds(stuck.since_s));
        let cause = in_one_line(&stuck.cause);
        let line = format!("no progress of {name} in {attempts} attempts for {since}: {cause}");
        paint.yellow(&line)
    }));
    if parts.is_empty() { String::new() } else { format!("  clips: {}\n", parts.join("; ")) }
}

/// Formats a resource that lambdas share: `memory: 1.2 MiB reserved of 8.0 MiB allowed`.
pub(super) fn shared(capacity: &Capacity) -> String {
    let number = |value: f64| amount(value, &capacity.unit);
    let [asked, most] = [capacity.asked, capacity.most].map(number);
    let used = capacity.used.map(|used| format!(", {} in use", number(used))).unwrap_or_default();
    format!("{}: {asked} reserved of {most} allowed{used}", visible(&capacity.resource))
}

fn amount(number: f64, unit: &str) -> String {
    match unit {
        "B" => size(number as u64),
        unit => format!("{number:.2} {}", visible(unit)),
    }
}

/// Returns the state of a deployment in a word or two.
pub(super) fn state(deployment: &DeploymentStatus) -> &'static str {
    match deployment.status.as_ref().map(|lambda| lambda.phase) {
        None if !deployment.is_wanted => "stopped",
        None => "unknown",
        Some(LambdaPhase::Running) if !deployment.is_proven => "on probation",
        Some(phase) => phase.as_str(),
    }
}

pub(super) fn version(deployment: &DeploymentStatus) -> String {
    let fallback = deployment.fallback.as_ref().filter(|_| deployment.runs_fallback);
    let mark = if fallback.is_some() { " (fallback)" } else { "" };
    format!("{}{mark}", visible(&fallback.unwrap_or(&deployment.revision).version))
}

/// Returns what was signed, and runs: deployments of one number differ by their digests.
fn content(deployment: &DeploymentStatus) -> String {
    let DeploymentStatus { id, release, envelope, revision, fallback, config, .. } = deployment;
    let runs = fallback.as_ref().filter(|_| deployment.runs_fallback).unwrap_or(revision);
    let set = config.iter().map(|(name, value)| format!(" {}={}", visible(name), visible(value)));
    format!(
        "{}: release {release} ({}), revision {} ({}){}",
        visible(id),
        short(envelope),
        runs.release,
        short(&runs.digest),
        set.collect::<String>()
    )
}

/// Returns the reasons why a deployment does not run as wanted, each with its subject.
pub(super) fn reasons(deployment: &DeploymentStatus) -> Vec<String> {
    let last_end = deployment.status.as_ref().and_then(|lambda| lambda.last_end.as_ref());
    let exceeds = deployment.demand.iter().find(|demand| demand.exceeds).map(|demand| {
        let asked = amount(demand.asked, &demand.unit);
        format!("{} {asked} ({})", demand.resource, demand.source)
    });
    let live = deployment.status.as_ref().and_then(|lambda| lambda.live.as_deref());
    let unwritten = live.map_or(0, |live| live.unwritten);
    let unwritten = (unwritten > 0).then(|| counted(unwritten, "decision or log line"));
    let all = [
        ("refused", deployment.refused.as_ref()),
        ("runs its fallback", deployment.failed.as_ref()),
        ("should be signed again", deployment.stale.as_ref()),
        ("uses more than it states", exceeds.as_ref()),
        ("last end", last_end),
        ("not written since its start", unwritten.as_ref()),
    ];
    let line =
        |(what, why): (&str, Option<&String>)| Some(format!("{what}: {}", in_one_line(why?)));
    let warnings = deployment.status.iter().flat_map(LambdaStatus::warnings).flatten();
    all.into_iter().filter_map(line).chain(warnings).collect()
}

/// Returns a line for each cause of data that the recorder lost.
fn losses(recorder: Option<&ProcessStatus<RecorderStatus>>, paint: Paint) -> String {
    let last = recorder.and_then(|recorder| recorder.last.as_deref());
    let counts = last.map(|last| last.recording.by_cause()).unwrap_or_default();
    let lost = counts.iter().filter(|it| it.count > 0 && it.outcome != LossOutcome::NoWindow);
    lost.map(|it| format!("    {}\n", paint.yellow(&it.describe()))).collect()
}

fn service<S>(name: &str, status: Option<&ProcessStatus<S>>, paint: Paint) -> String {
    let Some(status) = status else { return String::new() };
    let state = if status.is_ready { paint.green("ready") } else { paint.red("not ready") };
    let restarts = match &status.last_end {
        Some(reason) => format!(", restarts {}: {}", status.restarts, in_one_line(reason)),
        None => String::new(),
    };
    format!("  {name} {state}{restarts}\n")
}

fn row(deployment: &DeploymentStatus) -> [String; 11] {
    let lambda = deployment.status.as_ref();
    let seconds = lambda.map(|lambda| Duration::from_secs(lambda.phase_s as u64));
    let live = lambda.and_then(|lambda| lambda.live.as_deref());
    let latency = live.and_then(|live| live.wake_latency);
    [
        visible(&deployment.id),
        visible(&deployment.lambda),
        version(deployment),
        state(deployment).to_owned(),
        or_dash(seconds, format_duration),
        or_dash(lambda, |lambda| grouped(lambda.restarts)),
        or_dash(live, |live| grouped(live.wakes)),
        or_dash(live, |live| grouped(live.triggers)),
        or_dash(live, |live| grouped(live.faults)),
        or_dash(latency, |it| format!("{:.2} ms", it.p99_ns as f64 / 1e6)),
        or_dash(live, |live| size(live.rss_bytes)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_that_a_full_disk_refuses_is_named_with_counts_and_times() {
        let (stream, reason) = ("lambdas/brake".to_owned(), "DiskFull".to_owned());
        let (last_ns, failing_ns) = (1_000_000_060_000_000_000, 1_000_000_000_000_000_000);
        let loss = StreamLoss { stream, records: 2, reason, last_ns, waiting: 1266, failing_ns };
        let counts = "lost: 2, the last one at 2001-09-09T01:47:40Z; \
                      waiting for the disk: 1,266, since 2001-09-09T01:46:40Z";
        let cause = "the disk was full; check the disk and its room";
        assert_eq!(records_lost(&loss), format!("records of `brake` {counts}: {cause}"));
    }
}
