//! One process of a lambda, from its start to its end.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use gleaner_base::Exit;
use gleaner_protocol::{ExitRecord, Layer, LiveStatus, Phase};
use rustix::process::Signal;

use crate::last_error::{LastError, unexpected_end};
use crate::output::PIPES;
use crate::process::ChildProcess;
use crate::spec::LambdaSpec;

const SIGKILL: i32 = Signal::KILL.as_raw();
const SIGTERM: i32 = Signal::TERM.as_raw();

const ENDED_BY_ANOTHER: &str = "another program has ended its process";

pub(super) struct LambdaProcess {
    pub(super) child: ChildProcess,
    /// Its number in the group.
    pub(super) number: u32,
    pub(super) started: Instant,
    pub(super) open_pipes: u8,
    pub(super) readiness: Readiness,
    pub(super) worst: WorstFault,
    /// Set by the last report of the process.
    pub(super) has_ended: bool,
    pub(super) last: Option<Box<LiveStatus>>,
    /// The layers around it, as tested.
    pub(super) layers: Vec<Layer>,
    /// Number of statuses since the end of the drive.
    pub(super) after_drive: u32,
    pub(super) error: LastError,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Readiness {
    Starting,
    /// The ingress ended before the process was ready.
    WithoutService,
    /// The lambda has finished its `init`, at this time.
    Ready(Instant),
}

/// The worst fault of the lambda in one process.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum WorstFault {
    None,
    Counted,
    /// The process ended during a wake, which it could not count.
    LostWake,
}

pub(super) enum ProcessEnd {
    /// On request.
    Complete(Exit),
    /// The lambda could not start; a program has printed the cause.
    NotStarted(Exit, ProcessFailure),
    Failed(ProcessFailure),
}

/// An end that was not requested, or a start that failed.
pub(super) struct ProcessFailure {
    pub(super) reason: String,
    pub(super) has_faulted: bool,
    pub(super) cause: EndCause,
    pub(super) ran: Duration,
    /// Time for which it was ready, if it was.
    pub(super) ready_for: Option<Duration>,
}

#[derive(Clone, Copy)]
pub(super) enum EndCause {
    Fault,
    /// A start with the same files and settings fails again.
    Unusable,
    /// No fault of its own: no process was started, as the machine lacks what the sandbox or a
    /// process needs.
    Shortage,
    /// Another program killed it: not its shim, nor the kernel for its memory. In its own code, a
    /// lambda may have killed itself.
    Killed,
}

impl LambdaProcess {
    pub(super) fn new(child: ChildProcess, number: u32) -> Self {
        Self {
            child,
            number,
            started: Instant::now(),
            open_pipes: PIPES,
            readiness: Readiness::Starting,
            worst: WorstFault::None,
            has_ended: false,
            last: None,
            layers: Vec::new(),
            after_drive: 0,
            error: LastError::default(),
        }
    }

    pub(super) fn is_ready(&self) -> bool {
        matches!(self.readiness, Readiness::Ready(_))
    }

    pub(super) fn note_fault(&mut self, fault: WorstFault) {
        self.worst = self.worst.max(fault);
    }

    pub(super) fn note_counts(&mut self, live: Box<LiveStatus>) {
        self.note_fault(if live.faults > 0 { WorstFault::Counted } else { WorstFault::None });
        self.last = Some(live);
    }

    /// Returns how it has ended, with `status`. `is_ending` counts as a request if its shim left no
    /// record.
    pub(super) fn classify(
        &self,
        lambda: &LambdaSpec,
        status: ExitStatus,
        is_ending: bool,
    ) -> ProcessEnd {
        let record = ExitRecord::read(&lambda.exit_record()).ok();
        let is_kept = lambda.is_kept();
        // A lambda can end its process as if that had been requested. The shim records whether it
        // was requested, and in time.
        let requested = record.as_ref().map_or(is_ending, |record| record.end_requested);
        let is_killed = is_kept && was_killed_from_outside(record.as_ref(), status);
        let sender = if is_killed { ", by another program or by the lambda itself" } else { "" };
        let failure = |reason: &str, has_faulted, cause| ProcessFailure {
            reason: format!("{reason}{sender}"),
            has_faulted,
            cause: if is_killed { EndCause::Killed } else { cause },
            ran: self.started.elapsed(),
            ready_for: match self.readiness {
                Readiness::Ready(at) => Some(at.elapsed()),
                _ => None,
            },
        };
        let complete = |exit| match is_ending || !is_kept {
            true => ProcessEnd::Complete(exit),
            false => ProcessEnd::Failed(failure(ENDED_BY_ANOTHER, false, EndCause::Fault)),
        };
        match (status.code().and_then(Exit::from_code), self.error.message()) {
            // Ended before it could handle the signal.
            (None, _) if requested && !self.is_ready() => complete(Exit::Ok),
            (Some(exit @ (Exit::Ok | Exit::LambdaFaulted)), _) if requested && self.has_ended => {
                complete(exit)
            }
            // Our programs print an error before; another code is one that the lambda's code chose.
            (Some(exit), Some(error)) if !self.is_ready() && exit != Exit::Ok => {
                let cause = match exit {
                    // The shim records each end of a process that it has started, if it can: a full
                    // disk must not hide that the lambda is at fault.
                    Exit::Internal if record.is_none() => EndCause::Shortage,
                    Exit::Usage | Exit::Denied => EndCause::Unusable,
                    _ => EndCause::Fault,
                };
                // Of another one, the user has seen the message.
                let shown = if is_kept { format!(": {error}") } else { String::new() };
                let reason = format!("it could not start{shown}");
                let failure = failure(&reason, exit == Exit::LambdaFaulted, cause);
                ProcessEnd::NotStarted(exit, failure)
            }
            _ => {
                let reason = broken_reason(record.as_ref(), status);
                let is_caused = record.as_ref().is_some_and(ExitRecord::is_caused_by_lambda);
                let has_faulted = is_caused || self.worst > WorstFault::None;
                ProcessEnd::Failed(failure(&reason, has_faulted, EndCause::Fault))
            }
        }
    }
}

fn broken_reason(record: Option<&ExitRecord>, status: ExitStatus) -> String {
    match record {
        Some(ExitRecord { phase: Some(Phase::Init), code: Some(code), killed: None, .. }) => {
            format!("the lambda's code ended its process with exit code {code} in its constructor")
        }
        record => record.and_then(ExitRecord::sentence).map_or_else(
            || unexpected_end("the lambda's process", status),
            |reason| format!("the lambda's process {reason}"),
        ),
    }
}

fn was_killed_from_outside(record: Option<&ExitRecord>, status: ExitStatus) -> bool {
    let is_in_lambda =
        |record: &ExitRecord| matches!(record.phase, Some(Phase::Init | Phase::Wake));
    matches!(status.signal(), Some(SIGKILL | SIGTERM))
        && record.is_none_or(|it| it.killed.is_none() && !it.out_of_memory && !is_in_lambda(it))
}
