//! Output of the processes of a group: waits for it, and passes it to those whom it concerns.

use std::process::ExitStatus;
use std::time::{Duration, Instant};

use gleaner_base::Failure;

use crate::POLL_INTERVAL;
use crate::inference::InferenceEvent;
use crate::output::{ChildId, ChildOutput, OutputPiece};
use crate::process::ChildProcess;
use crate::process_group::ProcessGroup;

/// Time to read the pipes of a process after its end: processes that it left running may hold the
/// pipes open.
const DRAIN_TIMEOUT: Duration = Duration::from_millis(300);

impl ProcessGroup<'_> {
    /// Waits for the end of a process, and shows output meanwhile.
    pub(crate) fn wait(
        &mut self,
        child: impl Fn(&mut Self) -> Option<&mut ChildProcess>,
    ) -> Result<Option<ExitStatus>, Failure> {
        loop {
            let Some(process) = child(self) else { return Ok(None) };
            if let Some(status) = process.status()? {
                return Ok(Some(status));
            }
            if let Some(warning) = process.kill_if_late() {
                self.observer.warn(&warning);
            }
            self.poll(POLL_INTERVAL);
        }
    }

    /// Shows output while `is_open`, for [`DRAIN_TIMEOUT`] at most.
    pub(crate) fn drain(&mut self, is_open: impl Fn(&mut Self) -> bool) {
        let until = Instant::now() + DRAIN_TIMEOUT;
        while is_open(self) {
            let left = until.saturating_duration_since(Instant::now());
            match self.output.recv_timeout(left) {
                Ok(output) => self.show(output),
                Err(_) => return,
            }
        }
    }

    /// Waits for output and shows what is pending. Returns after `timeout` at the latest, so that a
    /// flood of output does not block the caller.
    pub(crate) fn poll(&mut self, timeout: Duration) {
        let until = Instant::now() + timeout;
        let mut wait = timeout;
        while let Ok(output) = self.output.recv_timeout(wait) {
            self.show(output);
            if Instant::now() >= until {
                return;
            }
            wait = Duration::ZERO;
        }
    }

    fn show(&mut self, ChildOutput { from, piece }: ChildOutput) {
        let Self { lambdas, ingress, recorder, observer, .. } = self;
        let is_stderr = matches!(piece, OutputPiece::Stderr(_));
        let recorder_start = recorder.as_ref().map(|recorder| recorder.restarts.start);
        // Processes that an earlier one left running may still write into its pipes.
        let mut current = match from {
            ChildId::Lambda { process } => lambdas.iter_mut().find(|it| it.runs_as(process)),
            ChildId::Ingress { start } if start != ingress.restarts.start && !is_stderr => return,
            ChildId::Recorder { start } if recorder_start != Some(start) && !is_stderr => return,
            _ => None,
        };
        match piece {
            OutputPiece::Bell => {}
            OutputPiece::Stderr(text) => {
                match (from, recorder) {
                    (ChildId::Lambda { .. }, _) => {
                        current.iter_mut().for_each(|current| current.has_written(&text));
                    }
                    (ChildId::Ingress { start }, _) if start == ingress.restarts.start => {
                        ingress.restarts.has_written(&text);
                    }
                    (ChildId::Recorder { start }, Some(recorder))
                        if start == recorder.restarts.start =>
                    {
                        recorder.restarts.has_written(&text);
                    }
                    _ => {}
                }
                observer.stderr(&text);
            }
            OutputPiece::Unparsable(line) => {
                let prefix = current.map_or("", |current| &current.lambda.prefix);
                observer.warn(&format!("{prefix}cannot parse a report: {line}"));
            }
            OutputPiece::Runtime(report) => {
                if let Some(current) = &mut current {
                    current.show(report, ingress.drive_ended, *observer);
                }
            }
            OutputPiece::Ingress(report) => ingress.show(report, *observer),
            OutputPiece::Inference(event) => {
                if let InferenceEvent::Ended(reason, ..) = &event {
                    self.failures.add(reason.clone(), false);
                }
                observer.inference(event);
            }
            OutputPiece::Recorder(report) => {
                if let Some(recorder) = recorder {
                    recorder.show(report, *observer);
                }
            }
            OutputPiece::Closed => match (from, current, recorder) {
                (ChildId::Ingress { .. }, ..) => ingress.open_pipes -= 1,
                (ChildId::Recorder { .. }, _, Some(recorder)) => recorder.open_pipes -= 1,
                (_, Some(current), _) => current.closed(),
                _ => {}
            },
        }
    }
}
