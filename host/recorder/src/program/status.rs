//! Reports of the loop to the starter.

use std::time::{Duration, Instant};

use gleaner_base::Failure;
use gleaner_protocol::link::{Loss, RecorderReport};
use tracing::{error, warn};

use super::report_writer::ReportWriter;
use crate::Recorder;

/// Interval of the status.
const INTERVAL: Duration = Duration::from_secs(1);

/// Reports what is new since its last report.
pub struct Reporter {
    reports: ReportWriter,
    /// Clips so far.
    clips: u64,
    /// Triggers so far that were suppressed.
    disk_suppressed: u64,
    status_at: Option<Instant>,
}

impl Reporter {
    pub fn new(reports: ReportWriter) -> Reporter {
        Reporter { reports, clips: 0, disk_suppressed: 0, status_at: None }
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
        let disk_suppressed = counts.recording.disk_suppressed - self.disk_suppressed;
        if disk_suppressed > 0 {
            self.disk_suppressed = counts.recording.disk_suppressed;
            let reason = "too little free disk space".to_owned();
            self.reports.send(RecorderReport::Loss(Loss::DiskSuppressed {
                at_ns,
                triggers: disk_suppressed,
                reason,
            }));
        }
        true
    }
}
