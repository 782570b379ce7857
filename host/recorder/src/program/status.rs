//! Reports of the loop to the starter.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use gleaner_base::Failure;
use gleaner_protocol::link::{Loss, RecordedTopic, RecorderReport, RecorderStatus};
use tracing::{error, warn};

use super::event_loop::{RecorderLoop, TopicEntry};
use crate::{RecorderCounts, TopicId};

/// The last reported counts.
#[derive(Default)]
pub(super) struct LastReported {
    clips: u64,
    disk_suppressed: u64,
    at: Option<Instant>,
}

impl RecorderLoop {
    /// Reports new clips, losses and, once a second, the status.
    pub(super) fn report(&mut self, is_last: bool) -> Result<(), Failure> {
        let counts = self.recorder.counts();
        let new =
            usize::try_from(counts.recording.clips - self.reported.clips).unwrap_or(usize::MAX);
        let clips = self.recorder.clips();
        for clip in &clips[clips.len().saturating_sub(new)..] {
            self.reports.send(RecorderReport::Clip(Box::new(clip.clone())));
        }
        self.reported.clips = counts.recording.clips;
        for clip in self.recorder.take_recovered() {
            warn!(
                clip = %clip.file.display(),
                "recovered a clip of an earlier recorder that died"
            );
            self.reports.send(RecorderReport::Recovered(Box::new(clip)));
        }
        let at_ns = self.clock.now();
        for error in self.recorder.take_failures() {
            let failure = Failure::from(error);
            error!(%failure, "cannot write a clip");
            let reason = std::iter::once(failure.message)
                .chain(failure.causes)
                .collect::<Vec<_>>()
                .join(": ");
            self.reports.send(RecorderReport::Loss(Loss::Failed { at_ns, reason }));
        }
        for loss in self.recorder.take_deleted() {
            self.reports.send(RecorderReport::Loss(loss));
        }
        if !is_last && self.reported.at.is_some_and(|at| at.elapsed() < Duration::from_secs(1)) {
            return Ok(());
        }
        self.reported.at = Some(Instant::now());
        let disk_suppressed = counts.recording.disk_suppressed - self.reported.disk_suppressed;
        if disk_suppressed > 0 {
            self.reported.disk_suppressed = counts.recording.disk_suppressed;
            let reason = "too little free disk space".to_owned();
            self.reports.send(RecorderReport::Loss(Loss::DiskSuppressed {
                at_ns,
                triggers: disk_suppressed,
                reason,
            }));
        }
        let spread = self.spreads.take();
        let status = RecorderStatus { trigger_to_open: spread, ..self.status(&counts) };
        self.reports.send(RecorderReport::Status(Box::new(status)));
        Ok(())
    }

    fn status(&self, counts: &RecorderCounts) -> RecorderStatus {
        let topic = |(id, entry): (&TopicId, &TopicEntry)| {
            let known = self.health.topics.iter().find(|(known, _)| known == id);
            let status = known.map(|(_, status)| status.clone()).unwrap_or_default();
            let arrivals = &entry.sink.arrivals;
            RecordedTopic {
                topic: entry.name.clone(),
                type_name: entry.type_name.clone(),
                writers: status.writers,
                received: arrivals.received.load(Ordering::Relaxed),
                lost: status.lost,
                no_slot: arrivals.no_slot.load(Ordering::Relaxed),
                too_big: arrivals.too_big.load(Ordering::Relaxed),
                malformed: status.malformed,
                qos: status.qos,
                qos_warnings: status.qos_warnings,
            }
        };
        let mut recording = counts.recording;
        recording.add(&self.counted);
        RecorderStatus {
            lambdas: self.lambdas.len(),
            recording,
            is_recording: self.recorder.is_recording(),
            preroll_bytes: counts.preroll_bytes,
            preroll_bound: counts.preroll_bound,
            in_flight: counts.in_flight,
            trigger_to_open: None,
            commands: self
                .commands
                .as_ref()
                .map(|commands| commands.status(self.health.commands.as_ref())),
            topics: self.topics.iter().map(topic).collect(),
            network: self.health.source.network.clone(),
            disk_free: self.health.disk_free,
            rss_bytes: self.health.rss_bytes,
            cpu_s: self.health.cpu_s,
        }
    }

    /// Returns the last status.
    pub(super) fn final_status(&mut self) -> RecorderStatus {
        let counts = self.recorder.counts();
        RecorderStatus { trigger_to_open: self.spreads.all(), ..self.status(&counts) }
    }
}
