//! What the processes of a run report, and what is shown of it.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_lambda::FaultKind;
use gleaner_protocol::link::{Loss, RecorderReport, RecorderStatus};
use gleaner_protocol::{Live, Report};

use super::screen::Screen;
use crate::show;

/// What is heard of a process.
pub(super) enum Heard {
    /// The lambda's process reports.
    Runtime(Report),
    /// The recorder reports.
    Recorder(RecorderReport),
    /// A report that cannot be understood.
    Garbled(String),
    /// Something for people.
    Said(Vec<u8>),
}

/// Hears all of them.
pub(super) struct Ear {
    heard: Receiver<Heard>,
    /// The lambda has had its `init`.
    pub(super) is_ready: bool,
    /// It has faulted.
    pub(super) has_faulted: bool,
    /// A wake has ended with its process, which could not count that.
    pub(super) has_lost_wake: bool,
    /// Its last report has come.
    pub(super) has_ended: bool,
    /// What it counted, as it said last.
    pub(super) last: Option<Live>,
    /// What the recorder counted, as it said last.
    pub(super) recorded: Option<Box<RecorderStatus>>,
}

impl Ear {
    pub(super) fn new(heard: Receiver<Heard>) -> Self {
        Self {
            heard,
            is_ready: false,
            has_faulted: false,
            has_lost_wake: false,
            has_ended: false,
            last: None,
            recorded: None,
        }
    }

    /// Shows what is heard for so long, or until all streams are closed.
    pub(super) fn listen(&mut self, screen: &mut Screen, patience: Duration) {
        let until = Instant::now() + patience;
        while let Ok(heard) =
            self.heard.recv_timeout(until.saturating_duration_since(Instant::now()))
        {
            self.show(heard, screen);
        }
    }

    /// Shows what is heard, until nothing is there; but not longer than this, or a flood would keep
    /// us from all else.
    pub(super) fn look(&mut self, screen: &mut Screen, patience: Duration) {
        let until = Instant::now() + patience;
        let mut wait = patience;
        loop {
            match self.heard.recv_timeout(wait) {
                Ok(heard) => self.show(heard, screen),
                Err(RecvTimeoutError::Timeout) => return,
                // Whoever asks again and again shall not be busy.
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

    fn show(&mut self, heard: Heard, screen: &mut Screen) {
        match heard {
            Heard::Said(piece) => screen.err(&piece),
            Heard::Garbled(line) => {
                screen.warn(&format!("a report that nobody understands: {line}"))
            }
            Heard::Runtime(report) => {
                screen.report(&report);
                self.show_runtime(report, screen);
            }
            Heard::Recorder(report) => {
                screen.report(&report);
                self.show_recorder(report, screen);
            }
        }
    }

    fn show_runtime(&mut self, report: Report, screen: &mut Screen) {
        match report {
            Report::Isolation { layers } => screen.say(&show::isolation(&layers)),
            Report::Ready => {
                self.is_ready = true;
                screen.say("running; ctrl-C ends it\n");
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
                screen.warn("recovered a clip of an earlier recorder, which did not end well");
                screen.clip(&clip);
            }
            RecorderReport::Loss(Loss::Deleted { file, why, .. }) => {
                screen.warn(&format!(
                    "deleted `{}`, which nobody had fetched: {why}",
                    file.display()
                ));
            }
            RecorderReport::Loss(Loss::NotDeleted { file, why, .. }) => {
                screen.warn(&format!("cannot delete `{}` to make room: {why}", file.display()));
            }
            RecorderReport::Loss(Loss::Failed { why, .. }) => {
                screen.warn(&format!("a clip could not be written: {why}"))
            }
            RecorderReport::Loss(Loss::DiskSuppressed { triggers, why, .. }) => {
                screen.warn(&format!("{triggers} triggers opened no window: {why}"));
            }
            RecorderReport::Status(status) => {
                screen.recorder(&status);
                self.recorded = Some(status);
            }
            RecorderReport::Ended(status) => {
                screen.recorder_ended(&status);
                self.recorded = Some(status);
            }
            RecorderReport::Ready => {}
        }
    }
}
