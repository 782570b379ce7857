//! Receives the output of the processes of a run, and passes it to the screen.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_lambda::FaultKind;
use gleaner_protocol::link::{Loss, RecorderReport, RecorderStatus};
use gleaner_protocol::{LiveStatus, Report};

use super::screen::Screen;
use crate::render;

/// Output of a child process.
pub(super) enum ChildOutput {
    /// A report of the lambda's process.
    Runtime(Report),
    /// A report of the recorder.
    Recorder(RecorderReport),
    /// The start of a line on standard output that cannot be parsed.
    Unparsable(String),
    /// A piece of standard error.
    Stderr(Vec<u8>),
}

/// Receives reports from all child processes.
pub(super) struct ReportStream {
    output: Receiver<ChildOutput>,
    /// Set when the lambda has finished its `init`.
    pub(super) is_ready: bool,
    /// Set when the lambda has faulted.
    pub(super) has_faulted: bool,
    /// Set when the process ended during a wake, which it could not count.
    pub(super) has_lost_wake: bool,
    /// Set by the last report of the lambda's process.
    pub(super) has_ended: bool,
    /// Last status of the lambda.
    pub(super) last: Option<LiveStatus>,
    /// Last status of the recorder.
    pub(super) recorder: Option<Box<RecorderStatus>>,
}

impl ReportStream {
    pub(super) fn new(output: Receiver<ChildOutput>) -> Self {
        Self {
            output,
            is_ready: false,
            has_faulted: false,
            has_lost_wake: false,
            has_ended: false,
            last: None,
            recorder: None,
        }
    }

    /// Shows output for the time `timeout`, or until all pipes are closed.
    pub(super) fn drain(&mut self, screen: &mut Screen, timeout: Duration) {
        let until = Instant::now() + timeout;
        while let Ok(output) =
            self.output.recv_timeout(until.saturating_duration_since(Instant::now()))
        {
            self.show(output, screen);
        }
    }

    /// Waits for output and shows what is pending. Returns after `timeout` at the latest, so that a
    /// flood of output does not block the caller.
    pub(super) fn poll(&mut self, screen: &mut Screen, timeout: Duration) {
        let until = Instant::now() + timeout;
        let mut wait = timeout;
        loop {
            match self.output.recv_timeout(wait) {
                Ok(output) => self.show(output, screen),
                Err(RecvTimeoutError::Timeout) => return,
                // Keeps a caller that polls in a loop from spinning.
                Err(RecvTimeoutError::Disconnected) => {
                    return thread::sleep(Duration::from_millis(10));
                }
            }
            if Instant::now() >= until {
                return;
            }
            wait = Duration::ZERO;
        }
    }

    fn show(&mut self, output: ChildOutput, screen: &mut Screen) {
        match output {
            ChildOutput::Stderr(piece) => screen.err(&piece),
            ChildOutput::Unparsable(line) => screen.warn(&format!("cannot parse a report: {line}")),
            ChildOutput::Runtime(report) => {
                screen.report(&report);
                self.show_runtime(report, screen);
            }
            ChildOutput::Recorder(report) => {
                screen.report(&report);
                self.show_recorder(report, screen);
            }
        }
    }

    fn show_runtime(&mut self, report: Report, screen: &mut Screen) {
        match report {
            Report::Isolation { layers } => screen.print(&render::isolation(&layers)),
            Report::Ready => {
                self.is_ready = true;
                screen.print("running; Ctrl-C ends it\n");
            }
            Report::Decision(decision) => {
                let fault = decision.fault.as_ref().map(|fault| fault.kind);
                self.has_faulted |= fault.is_some();
                self.has_lost_wake |= fault == Some(FaultKind::Killed);
                screen.decision(&decision);
            }
            Report::Live(live) => {
                self.has_faulted |= live.faults > 0;
                screen.live(&live);
                self.last = Some(*live);
            }
            Report::Ended(live) => {
                self.has_ended = true;
                self.has_faulted |= live.faults > 0;
                screen.ended(&live);
                self.last = Some(*live);
            }
            _ => {}
        }
    }

    fn show_recorder(&mut self, report: RecorderReport, screen: &mut Screen) {
        match report {
            RecorderReport::Clip(clip) => screen.clip(&clip),
            RecorderReport::Recovered(clip) => {
                screen.warn("recovered a clip of an earlier recorder that crashed");
                screen.clip(&clip);
            }
            RecorderReport::Loss(Loss::Deleted { file, reason, .. }) => {
                screen.warn(&format!("deleted the clip `{}`: {reason}", file.display()));
            }
            RecorderReport::Loss(Loss::NotDeleted { file, reason, .. }) => {
                screen.warn(&format!("cannot delete the clip `{}`: {reason}", file.display()));
            }
            RecorderReport::Loss(Loss::Failed { reason, .. }) => {
                screen.warn(&format!("cannot write a clip: {reason}"))
            }
            RecorderReport::Loss(Loss::DiskSuppressed { triggers, reason, .. }) => {
                screen.warn(&format!("{triggers} triggers without a window: {reason}"));
            }
            RecorderReport::Status(status) => {
                screen.recorder(&status);
                self.recorder = Some(status);
            }
            RecorderReport::Ended(status) => {
                screen.recorder_ended(&status);
                self.recorder = Some(status);
            }
            RecorderReport::Ready => {}
        }
    }
}
