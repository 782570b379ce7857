//! Output of the processes of a group: waits for it, and passes it to those whom it concerns.

use std::process::ExitStatus;
use std::time::{Duration, Instant};

use gleaner_base::Failure;

use super::ProcessGroup;
use crate::POLL_INTERVAL;
use crate::inference::InferenceEvent;
use crate::output::{ChildId, ChildOutput, OutputPiece};
use crate::process::ChildProcess;

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
        // Processes that an earlier one left running may still write into its pipes.
        let lambda = match from {
            ChildId::Lambda(process) => {
                lambdas.iter_mut().find(|it| it.process_number() == Some(process))
            }
            _ => None,
        };
        let service = match (from, &mut *recorder) {
            (ChildId::Ingress(start), _) => Some((&mut ingress.restarts, start)),
            (ChildId::Recorder(start), Some(recorder)) => Some((&mut recorder.restarts, start)),
            _ => None,
        };
        let service = service.filter(|(it, start)| it.start == *start).map(|(it, _)| it);
        let is_of_service = matches!(from, ChildId::Ingress(_) | ChildId::Recorder(_));
        if is_of_service && service.is_none() && !matches!(piece, OutputPiece::Stderr(_)) {
            return;
        }
        match piece {
            OutputPiece::Notice => {}
            OutputPiece::Stderr(text) => {
                if let Some(service) = service {
                    service.has_written(&text);
                }
                if let Some(lambda) = lambda {
                    lambda.has_written(&text);
                }
                observer.stderr(&text);
            }
            OutputPiece::Unparsable(line) => {
                let prefix = lambda.map_or("", |supervised| &supervised.lambda.prefix);
                observer.warn(&format!("{prefix}cannot parse a report: {line}"));
            }
            OutputPiece::Runtime(report) => {
                if let Some(lambda) = lambda {
                    lambda.show(report, ingress.drive_ended, *observer);
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
            OutputPiece::Closed => {
                if let Some(service) = service {
                    service.open_pipes -= 1;
                }
                if let Some(lambda) = lambda {
                    lambda.closed();
                }
            }
        }
    }
}
