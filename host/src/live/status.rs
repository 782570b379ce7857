//! The status of a live lambda: counters per wake, reported once a second.

use std::path::PathBuf;
use std::sync::Arc;

use gleaner_lambda::Decision;
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::transport::Clock;
use gleaner_protocol::process_stats::{IntervalDurations, usage};
use gleaner_protocol::{DurationStats, LinkLosses, LiveStatus, LiveTopic};
use gleaner_samples::ReconnectingReader;

use crate::api::Session;
use crate::api::data::Topic;
use crate::input::Remap;
use crate::schedule::WakeSchedule;

/// Time between two reports.
const EVERY_NS: i64 = 1_000_000_000;

/// Times of a wake, in ns of the vehicle's clock.
pub(super) struct Times {
    /// Reception of the sample, or due time of the tick.
    pub(super) at: i64,
    /// Start of the lambda's call.
    pub(super) entered: i64,
    /// End of the lambda's call.
    pub(super) left: i64,
    /// Time at which the decision was sent.
    pub(super) out: i64,
}

/// Other sources of a report.
pub(super) struct StatusContext<'a> {
    pub(super) feed: &'a ReconnectingReader,
    pub(super) inputs: &'a [Arc<Topic>],
    pub(super) schedule: &'a WakeSchedule,
    pub(super) session: &'a Session,
    /// Number of decisions and lines that could not be written.
    pub(super) unwritten: u64,
    /// Number of messages that were not sent on requested topics.
    pub(super) unsent: u64,
    /// Wakes and triggers that could not be sent to the recorder, if there is one.
    pub(super) recorder_link: Option<LinkLosses>,
}

pub(super) struct StatusReporter {
    base: LiveStatus,
    clock: Clock,
    started: i64,
    reported: i64,
    wake_latency: IntervalDurations,
    run: IntervalDurations,
    decision_latency: IntervalDurations,
    /// Samples that each input had received at the previous report.
    before: Vec<u64>,
    /// Topics after remapping.
    wire: Vec<String>,
}

impl StatusReporter {
    pub(super) fn new(
        manifest: &Manifest,
        remaps: &[Remap],
        out: PathBuf,
        restarts: u32,
        clock: Clock,
    ) -> Self {
        let now = clock.now();
        let lambda = &manifest.lambda;
        let (name, version) = (lambda.name.as_str(), lambda.version.to_string());
        let base = LiveStatus { restarts, ..LiveStatus::new(name, &version, lambda.kind, out) };
        let wire = manifest
            .inputs
            .iter()
            .map(|input| Remap::apply(remaps, input.topic.as_str()).to_owned());
        Self {
            base,
            clock,
            started: now,
            reported: now,
            wake_latency: IntervalDurations::new(),
            run: IntervalDurations::new(),
            decision_latency: IntervalDurations::new(),
            before: vec![0; manifest.inputs.len()],
            wire: wire.collect(),
        }
    }

    pub(super) fn woke(&mut self, decision: &Decision, log_lines: usize, times: Times) {
        self.base.wakes += 1;
        self.base.triggers += decision.triggers.len() as u64;
        self.base.faults += u64::from(decision.fault.is_some());
        self.base.log_lines += log_lines as u64;
        self.wake_latency.add(times.entered.saturating_sub(times.at));
        self.run.add(times.left.saturating_sub(times.entered));
        self.decision_latency.add(times.out.saturating_sub(times.left));
    }

    /// Number of wakes that ended in a fault.
    pub(super) fn faults(&self) -> u64 {
        self.base.faults
    }

    pub(super) fn is_due(&self, now: i64) -> bool {
        now.saturating_sub(self.reported) >= EVERY_NS
    }

    /// The status since the last report.
    pub(super) fn report(&mut self, around: &StatusContext) -> LiveStatus {
        let spreads = [self.wake_latency.take(), self.run.take(), self.decision_latency.take()];
        self.as_of_now(around, spreads)
    }

    /// The status of the whole run.
    pub(super) fn ended(mut self, around: &StatusContext) -> LiveStatus {
        self.reported = self.started;
        self.before.fill(0);
        let spreads = [self.wake_latency.all(), self.run.all(), self.decision_latency.all()];
        self.as_of_now(around, spreads)
    }

    fn as_of_now(
        &mut self,
        around: &StatusContext,
        [wake_latency, run, decision_latency]: [Option<DurationStats>; 3],
    ) -> LiveStatus {
        let StatusContext { feed, inputs, schedule, session, unwritten, unsent, recorder_link } =
            *around;
        let now = self.clock.now();
        let seconds = now.saturating_sub(self.reported) as f64 / 1e9;
        self.reported = now;
        let mut topics = Vec::with_capacity(inputs.len());
        // An input's topic has the input's index as its id.
        for ((index, topic), id) in inputs.iter().enumerate().zip(0..) {
            let status = feed.reception(id).unwrap_or_default();
            topic.set_lost(status.lost);
            let counts = topic.counts();
            let came = counts
                .received
                .saturating_sub(std::mem::replace(&mut self.before[index], counts.received));
            topics.push(LiveTopic {
                name: topic.name().to_owned(),
                topic: self.wire[index].clone(),
                type_name: topic.type_name().to_owned(),
                writers: status.writers,
                rate_hz: if seconds > 0.0 { came as f64 / seconds } else { 0.0 },
                received: counts.received,
                lost: status.lost,
                malformed: status.malformed,
                overwritten: counts.overwritten,
                no_slot: counts.no_slot,
                too_big: counts.too_big,
                skipped: counts.skipped,
                age_ns: topic.newest_at().map(|at| now.saturating_sub(at)),
                qos: status.qos,
                qos_warnings: status.qos_warnings,
            });
        }
        LiveStatus {
            up_s: now.saturating_sub(self.started) as f64 / 1e9,
            skipped: topics.iter().map(|topic| topic.skipped).sum(),
            missed_ticks: schedule.missed(),
            log_dropped: session.log_dropped(),
            triggers_refused: session.triggers_refused(),
            backed_off: session.backed_off(),
            unwritten,
            unsent,
            recorder_link,
            wake_latency,
            run_time: run,
            decision_latency,
            topics,
            network: feed.status().health.network.clone().unwrap_or_default(),
            reception_gaps: feed.gaps(),
            rss_bytes: usage::resident(),
            cpu_s: usage::cpu_seconds(),
            ..self.base.clone()
        }
    }
}
