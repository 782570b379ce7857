//! The status that a vehicle has reported: every text in it is the vehicle's.

use gleaner_protocol::supervision::{LambdaStatus, SupervisorStatus};
use gleaner_protocol::vehicle_api::{Capacity, CloudStatus, DeploymentStatus, VehicleStatus};
use gleaner_protocol::{DurationStats, Holds, LiveStatus, LiveTopic};
use maud::{Markup, html};

use super::charts;
use super::layout::empty;
use super::text::{amount, bytes, count, duration, segment, short, shown, span, time};

/// Maximum number of lambdas, of topics of one, and of layers that are shown.
const LAMBDAS_MAX: usize = 100;
const TOPICS_MAX: usize = 40;

/// Renders all of it. `here` is the path of the vehicle.
pub(super) fn all(here: &str, status: &VehicleStatus) -> Markup {
    html! {
        section aria-labelledby="lambdas" {
            h2 id="lambdas" { "Lambdas" }
            @if status.deployments.is_empty() {
                (empty("No lambda is deployed to this vehicle."))
            }
            @for deployment in status.deployments.iter().take(LAMBDAS_MAX) {
                (lambda(here, deployment))
            }
            @if status.deployments.len() > LAMBDAS_MAX {
                p { (status.deployments.len() - LAMBDAS_MAX)
                    " more: `gleaner status --on` shows all" }
            }
        }
        div.pair {
            (capacity(&status.capacity))
            (vehicle(status))
        }
    }
}

fn lambda(here: &str, deployment: &DeploymentStatus) -> Markup {
    let DeploymentStatus { id, lambda, revision, release, failed, .. } = deployment;
    let status = deployment.status.as_ref();
    let fallback = deployment.fallback.as_ref().filter(|_| deployment.runs_fallback);
    let runs = fallback.unwrap_or(revision);
    let phase = status.map_or("not started", |status| status.phase.as_str());
    let (class, state) = match phase {
        "running" if deployment.runs_fallback => ("waiting", "runs its fallback"),
        "running" => ("running", phase),
        "quarantined" => ("failed", phase),
        _ => ("waiting", phase),
    };
    html! {
        article.card {
            h3 {
                a href=(format!("{here}/lambdas/{}", segment(id))) { (shown(id)) } " "
                span.state.(class) { (state) }
                @if !deployment.is_wanted { " " span.state.other { "stopped by a user" } }
            }
            p.dim {
                (shown(lambda)) " " (shown(&runs.version))
                @if fallback.is_some() { " " span.warn { "(fallback)" } }
                ", release " (release) ", revision " code { (short(&runs.digest)) }
            }
            @if let Some(reason) = failed {
                p.bad { "release " (release) " (" (shown(&revision.version)) ") "
                    (if reason.starts_with("rolled back by") { "was " } else { "failed: " })
                    (shown(reason)) }
            }
            @if let Some(reason) = &deployment.refused { p.bad { (shown(reason)) } }
            @if let Some(reason) = &deployment.stale { p.warn { (shown(reason)) } }
            @if let Some(status) = status { (process(status)) }
        }
    }
}

fn process(status: &LambdaStatus) -> Markup {
    html! {
        @for warning in status.warnings().into_iter().flatten() { p.warn { (shown(&warning)) } }
        dl.facts {
            div { dt { "In state for" } dd { (span(status.phase_s)) } }
            div { dt { "Restarts" } dd { (status.restarts) } }
            @if let Some(live) = &status.live {
                div { dt { "Wakes" } dd { (gleaner_base::grouped(live.wakes)) } }
                div { dt { "Triggers" } dd { (gleaner_base::grouped(live.triggers)) } }
                div { dt { "Faults" } dd { (number_of(live.faults)) } }
                div { dt { "Memory" } dd { (bytes(live.rss_bytes as f64)) } }
            }
        }
        @if let Some(end) = &status.last_end { p.dim { "Last end: " (shown(end)) } }
        @if let Some(live) = &status.live { (latency(live)) (losses(live)) (topics(live)) }
        @if !status.layers.is_empty() { (sandbox(status)) }
    }
}

/// Renders a number that should be 0.
fn number_of(number: u64) -> Markup {
    html! { @if number == 0 { "0" } @else { span.warn { (gleaner_base::grouped(number)) } } }
}

fn latency(live: &LiveStatus) -> Markup {
    let rows: [(&str, Option<DurationStats>); 3] = [
        ("Sample to wake", live.wake_latency),
        ("In the lambda", live.run_time),
        ("Return to decision", live.decision_latency),
    ];
    html! {
        @if rows.iter().any(|(_, stats)| stats.is_some()) {
            div.scroll {
                table.tight {
                    caption { "Latency since the previous report; scale from 1 µs to 10 s" }
                    thead { tr { th scope="col" { "Step" } th.number scope="col" { "p50" }
                        th.number scope="col" { "p99" } th.number scope="col" { "max" }
                        th.optional scope="col" { span.hidden { "Chart" } } } }
                    tbody { @for (name, stats) in rows { @if let Some(stats) = stats {
                        tr {
                            th scope="row" { (name) }
                            @for ns in [stats.p50_ns, stats.p99_ns, stats.max_ns] {
                                td.number { (duration(ns)) }
                            }
                            td.optional.chart { (charts::spread(&stats)) }
                        }
                    } } }
                }
            }
        }
    }
}

fn losses(live: &LiveStatus) -> Markup {
    let link = live.recorder_link.unwrap_or_default();
    let all = [
        (live.skipped, "event samples did not wake it"),
        (live.missed_ticks, "ticks came during a wake"),
        (live.log_dropped, "log lines were over the rate limit"),
        (live.triggers_refused, "triggers were over the limit per minute"),
        (live.backed_off, "wakes were skipped after faults"),
        (live.unwritten, "decisions and log lines were not written"),
        (live.unsent, "messages were not sent"),
        (live.network.socket_drops, "datagrams found a full buffer"),
        (live.network.filtered, "harmful datagrams were dropped"),
        (live.reception_gaps.count, "gaps of reception"),
        (link.wakes_dropped, "wakes did not reach the recorder"),
        (link.triggers_lost, "triggers did not reach the recorder"),
    ];
    let lost: Vec<_> = all.into_iter().filter(|(number, _)| *number > 0).collect();
    let has_all_samples = live.topics.iter().all(|topic| samples_lost(topic) == Some(0));
    html! {
        p {
            b { "Losses: " }
            @if lost.is_empty() {
                span.good { "none" @if !has_all_samples { " besides those of its topics" } } }
            @for (index, (number, what)) in lost.iter().enumerate() {
                @if index > 0 { ", " }
                span.warn { (gleaner_base::grouped(number)) " " (what) }
            }
        }
    }
}

/// Returns the number of samples of a topic that the lambda did not get, if it is known.
fn samples_lost(topic: &LiveTopic) -> Option<u64> {
    let dropped = [topic.malformed, topic.no_slot, topic.too_big, topic.skipped];
    topic.lost.map(|lost| dropped.into_iter().fold(lost, u64::saturating_add))
}

fn topics(live: &LiveStatus) -> Markup {
    html! {
        @if !live.topics.is_empty() {
            div.scroll {
                table.tight {
                    caption { "Topics" }
                    thead { tr { th scope="col" { "Topic" } th.number scope="col" { "Rate" }
                        th.number scope="col" { "Received" } th.number scope="col" { "Lost" }
                        th.number.optional scope="col" { "Age" } } }
                    tbody { @for topic in live.topics.iter().take(TOPICS_MAX) {
                        tr {
                            th scope="row" { (shown(&topic.topic))
                                @for warning in topic.qos_warnings.iter().take(3) {
                                    div.warn { (shown(warning)) } } }
                            td.number { (format!("{:.1} Hz", topic.rate_hz)) }
                            td.number { (gleaner_base::grouped(topic.received)) }
                            td.number {
                                @match samples_lost(topic) {
                                    None => span.dim { "unknown" },
                                    Some(lost) => (number_of(lost)),
                                }
                            }
                            td.number.optional {
                                @match topic.age_ns.and_then(|ns| u64::try_from(ns).ok()) {
                                    None => span.dim { "–" },
                                    Some(ns) => (duration(ns)),
                                }
                            }
                        }
                    } }
                }
            }
            @if live.topics.len() > TOPICS_MAX {
                p.dim { (live.topics.len() - TOPICS_MAX) " more topics" }
            }
        }
    }
}

fn sandbox(status: &LambdaStatus) -> Markup {
    html! {
        p { b { "Sandbox (checked at start): " } }
        ul.layers {
            @for layer in status.layers.iter().take(TOPICS_MAX) {
                li {
                    @let (class, text) = match layer.holds {
                        Holds::Yes => ("good", "active"),
                        Holds::Partly => ("warn", "partial"),
                        Holds::No => ("bad", "missing"),
                    };
                    (shown(&layer.name)) ": " span.(class) { (text) }
                    " " span.dim { (shown(&layer.note)) }
                }
            }
        }
    }
}

fn capacity(all: &[Capacity]) -> Markup {
    html! {
        section.card aria-labelledby="capacity" {
            h2 id="capacity" { "Resources" }
            @if all.is_empty() { (empty("None are reported.")) }
            @for resource in all.iter().take(TOPICS_MAX) {
                @let used = resource.used.map(|used| amount(used, &resource.unit));
                p.resource {
                    b { (shown(&resource.resource)) } ": "
                    (amount(resource.asked, &resource.unit)) " reserved of "
                    (amount(resource.most, &resource.unit)) " allowed"
                    @if let Some(used) = used { ", " (used) " in use" }
                }
                (charts::share(resource.asked, resource.most))
            }
        }
    }
}

fn vehicle(status: &VehicleStatus) -> Markup {
    let program = &status.orchestrator;
    html! {
        section.card aria-labelledby="vehicle-title" {
            h2 id="vehicle-title" { "Vehicle" }
            dl {
                dt { "Orchestrator" }
                dd { "up " (span(program.up_s)) ", " (bytes(program.rss_bytes as f64)) }
                dt { "Trust root" }
                dd {
                    @match &status.trust {
                        None => span.bad { "none is installed" },
                        Some(trust) => {
                            "version " (trust.version) ", until "
                            (time(trust.expires))
                            @if trust.is_expired { " " span.bad { "expired" } }
                        },
                    }
                }
                @if let Some(cloud) = &status.cloud { (connection(cloud)) }
                dt { "Spool" }
                dd {
                    @let lost = status.events_lost
                        .saturating_add(status.supervisor.as_ref().map_or(0, |it| it.events_lost));
                    @if lost > 0 { span.warn { (count(lost, "event")) " lost" } }
                    @else if status.records_lost.is_empty() { "no losses" }
                    @else { "no events lost" }
                    @for lost in status.records_lost.iter().take(LAMBDAS_MAX) {
                        br; span.warn {
                            "records of " (shown(&lost.stream))
                            @if lost.records > 0 { ", " (lost.records) " lost" }
                            @if lost.waiting > 0 { ", " (lost.waiting) " waiting for the disk" }
                        }
                    }
                }
                @match &status.supervisor {
                    None => { dt { "Supervisor" } dd { span.bad { "cannot be reached" } } },
                    Some(supervisor) => (processes(supervisor)),
                }
            }
        }
    }
}

fn connection(cloud: &CloudStatus) -> Markup {
    html! {
        dt { "Connection" }
        dd { (shown(&cloud.state)) " for " (span(cloud.since_s))
            @if let Some(reason) = &cloud.reason { ": " (shown(reason)) } }
        dt { "Unsent records" }
        dd { (gleaner_base::grouped(cloud.unsent))
            @if cloud.uncounted > 0 {
                ", and those of " (count(cloud.uncounted, "stream")) " not counted"
            }
            @for it in cloud.failing.iter().take(LAMBDAS_MAX) {
                br; span.warn {
                    (count(it.streams, "stream")) " not sent for " (span(it.since_s)) ", tried "
                    (span(it.tried_s)) " ago: " (shown(&it.example))
                }
            }
        }
    }
}

fn processes(supervisor: &SupervisorStatus) -> Markup {
    let ingress = &supervisor.ingress;
    let mut all = vec![("Ingress", ingress.is_ready, ingress.restarts, &ingress.last_end)];
    if let Some(it) = &supervisor.recorder {
        all.push(("Recorder", it.is_ready, it.restarts, &it.last_end));
    }
    if let Some(it) = &supervisor.inference {
        all.push(("Models", it.is_ready, it.restarts, &it.last_end));
    }
    let free = supervisor.recorder.as_ref().and_then(|it| it.last.as_ref()?.disk_free);
    html! {
        @for (name, is_ready, restarts, end) in all {
            dt { (name) }
            dd {
                @if is_ready { span.good { "ready" } } @else { span.warn { "not ready" } }
                @if restarts > 0 { ", " (count(u64::from(restarts), "restart")) }
                @if let Some(end) = end { ", last end: " (shown(end)) }
            }
        }
        dt { "Clips" }
        dd { (supervisor.clips) " since its start"
            @if let Some(free) = free { ", " (bytes(free as f64)) " of disk free" } }
    }
}
