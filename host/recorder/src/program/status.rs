//! Reports of the loop to the starter.

use std::time::{Duration, Instant};

use gleaner_base::Failure;
use gleaner_protocol::link::{Loss, RecorderReport};
use tracing::{error, warn};

use super::report_writer::ReportWriter;
use crate::Recorder;

const INTERVAL: Duration = Duration::from_secs(1);

/// Reports what is new since its last report.
pub struct Reporter {
    reports: ReportWriter,
    clips: u64,
    /// Triggers so far that were suppressed, and reported.
    disk_suppressed: u64,
    /// Set while recording is suspended, once a suppressed trigger was reported.
    is_suspended: bool,
    status_at: Option<Instant>,
}

impl Reporter {
    pub fn new(reports: ReportWriter) -> Reporter {
        Reporter { reports, clips: 0, disk_suppressed: 0, is_suspended: false, status_at: None }
    }

    pub fn send(&mut self, report: RecorderReport) {
        self.reports.send(report);
    }

    /// Sends the last report, and waits until all is written.
    pub fn end(self, report: RecorderReport) {
        self.reports.end(report);
    }

    /// Reports new clips and losses; returns whether the status is due, once a second.
    pub fn report(&mut self, recorder: &mut Recorder, at_ns: i64, is_last: bool) -> bool {
        let counts = recorder.counts();
        let new = usize::try_from(counts.recording.clips - self.clips).unwrap_or(usize::MAX);
        let clips = recorder.clips();
        for clip in &clips[clips.len().saturating_sub(new)..] {
            self.reports.send(RecorderReport::Clip(Box::new(clip.clone())));
        }
        self.clips = counts.recording.clips;
        for clip in recorder.take_recovered() {
            warn!(
                clip = %clip.file.display(),
                "recovered a clip of an earlier recorder that died"
            );
            self.reports.send(RecorderReport::Recovered(Box::new(clip)));
        }
        for error in recorder.take_failures() {
            let failure = Failure::from(error);
            error!(%failure, "cannot write a clip");
            let reason = std::iter::once(failure.message)
                .chain(failure.causes)
                .collect::<Vec<_>>()
                .join(": ");
            self.reports.send(RecorderReport::Loss(Loss::Failed { at_ns, reason }));
        }
        for loss in recorder.take_deleted() {
            self.reports.send(RecorderReport::Loss(loss));
        }
        if !is_last && self.status_at.is_some_and(|at| at.elapsed() < INTERVAL) {
            return false;
        }
        self.status_at = Some(Instant::now());
        let triggers = counts.recording.disk_suppressed - self.disk_suppressed;
        // The first at once; those after them in one sum, at the end of the suspension.
        let is_over = is_last || !recorder.is_held();
        if triggers > 0 && (is_over || !self.is_suspended) {
            self.disk_suppressed = counts.recording.disk_suppressed;
            let reason = match self.is_suspended {
                true => "too little free disk space until now",
                false => "too little free disk space",
            };
            let loss = Loss::DiskSuppressed { at_ns, triggers, reason: reason.to_owned() };
            self.reports.send(RecorderReport::Loss(loss));
            self.is_suspended = true;
        }
        self.is_suspended &= !is_over;
        true
    }
}
