//! What the loop tells the starter.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use gleaner_base::Failure;
use gleaner_protocol::link::{Loss, RecordedTopic, RecorderReport, RecorderStatus};
use tracing::{error, warn};

use super::course::{Course, Recorded};
use crate::{Counts, TopicId};

/// What was told of the counts.
#[derive(Default)]
pub(super) struct Said {
    clips: u64,
    disk_suppressed: u64,
    at: Option<Instant>,
}

impl Course {
    /// Tells what is new.
    pub(super) fn tell(&mut self, is_last: bool) -> Result<(), Failure> {
        let counts = self.recorder.counts();
        let new = usize::try_from(counts.recording.clips - self.said.clips).unwrap_or(usize::MAX);
        let clips = self.recorder.clips();
        for clip in &clips[clips.len().saturating_sub(new)..] {
            self.say.say(RecorderReport::Clip(Box::new(clip.clone())));
        }
        self.said.clips = counts.recording.clips;
        for clip in self.recorder.take_recovered() {
            warn!(clip = %clip.file.display(), "recovered a clip of an earlier recorder, which did not end well");
            self.say.say(RecorderReport::Recovered(Box::new(clip)));
        }
        let at_ns = self.clock.now();
        for error in self.recorder.take_failures() {
            let failure = Failure::from(error);
            error!(%failure, "a clip could not be written");
            let why = std::iter::once(failure.message)
                .chain(failure.causes)
                .collect::<Vec<_>>()
                .join(": ");
            self.say.say(RecorderReport::Loss(Loss::Failed { at_ns, why }));
        }
        for loss in self.recorder.take_deleted() {
            self.say.say(RecorderReport::Loss(loss));
        }
        if !is_last && self.said.at.is_some_and(|at| at.elapsed() < Duration::from_secs(1)) {
            return Ok(());
        }
        self.said.at = Some(Instant::now());
        let disk_suppressed = counts.recording.disk_suppressed - self.said.disk_suppressed;
        if disk_suppressed > 0 {
            self.said.disk_suppressed = counts.recording.disk_suppressed;
            let why = "the disk had too little room".to_owned();
            self.say.say(RecorderReport::Loss(Loss::DiskSuppressed {
                at_ns,
                triggers: disk_suppressed,
                why,
            }));
        }
        let spread = self.spreads.take();
        let status = RecorderStatus { trigger_to_open: spread, ..self.status(&counts) };
        self.say.say(RecorderReport::Status(Box::new(status)));
        Ok(())
    }

    fn status(&self, counts: &Counts) -> RecorderStatus {
        let topic = |(id, of): (&TopicId, &Recorded)| {
            let known = self.beat.topics.iter().find(|(known, _)| known == id);
            let status = known.map(|(_, status)| status.clone()).unwrap_or_default();
            let arrivals = &of.lane.arrivals;
            RecordedTopic {
                topic: of.name.clone(),
                type_name: of.type_name.clone(),
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
                .map(|commands| commands.status(self.beat.commands.as_ref())),
            topics: self.topics.iter().map(topic).collect(),
            network: self.beat.health.network.clone(),
            disk_free: self.beat.disk_free,
            rss_bytes: self.beat.rss_bytes,
            cpu_s: self.beat.cpu_s,
        }
    }

    /// The last status.
    pub(super) fn last_words(&mut self) -> RecorderStatus {
        let counts = self.recorder.counts();
        RecorderStatus { trigger_to_open: self.spreads.all(), ..self.status(&counts) }
    }
}
