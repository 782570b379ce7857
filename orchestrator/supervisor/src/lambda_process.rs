//! One process of a lambda, from its start to its end.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::Instant;

use gleaner_base::Exit;
use gleaner_protocol::{ExitRecord, Layer, LiveStatus, Phase};
use rustix::process::Signal;

use crate::last_error::LastError;
use crate::output::PIPES;
use crate::process::{ChildProcess, ended};
use crate::spec::LambdaSpec;

const SIGKILL: i32 = Signal::KILL.as_raw();
const SIGTERM: i32 = Signal::TERM.as_raw();

pub(crate) struct LambdaProcess {
    pub(crate) child: ChildProcess,
    /// Its number in the group.
    pub(crate) number: u32,
    pub(crate) started: Instant,
    pub(crate) open_pipes: u8,
    /// Set when the lambda has finished its `init`.
    pub(crate) is_ready: bool,
    pub(crate) has_faulted: bool,
    /// Set when the process ended during a wake, which it could not count.
    pub(crate) has_lost_wake: bool,
    /// Set by the last report of the process.
    pub(crate) has_ended: bool,
    /// Set when the ingress ended before the process was ready.
    pub(crate) has_lost_service: bool,
    pub(crate) last: Option<Box<LiveStatus>>,
    /// The layers around it, as tested.
    pub(crate) layers: Vec<Layer>,
    /// Number of statuses since the end of the drive.
    pub(crate) after_drive: u32,
    /// The last error message on its standard error.
    pub(crate) error: LastError,
}

pub(crate) enum ProcessEnd {
    /// On request.
    Complete(Exit),
    /// The lambda could not start; a program has printed the cause. It is `blameless` if its shim
    /// started no process, as the machine lacks what the sandbox or a process needs.
    NotStarted {
        exit: Exit,
        blameless: bool,
    },
    Broken {
        reason: String,
        faulted: bool,
    },
}

impl LambdaProcess {
    pub(crate) fn new(child: ChildProcess, number: u32) -> Self {
        Self {
            child,
            number,
            started: Instant::now(),
            open_pipes: PIPES,
            is_ready: false,
            has_faulted: false,
            has_lost_wake: false,
            has_ended: false,
            has_lost_service: false,
            last: None,
            layers: Vec::new(),
            after_drive: 0,
            error: LastError::default(),
        }
    }

    /// Returns the reason for a start that failed, with its error message if it is not shown.
    pub(crate) fn not_started(&self, with_error: bool) -> String {
        match self.error.message().filter(|_| with_error) {
            Some(error) => format!("it could not start: {error}"),
            None => "it could not start".to_owned(),
        }
    }

    /// Returns whether another program has killed it: not its shim, nor the kernel for its memory.
    /// In its own code, a lambda may have killed itself.
    pub(crate) fn was_killed_from_outside(&self, lambda: &LambdaSpec, status: ExitStatus) -> bool {
        let killed = matches!(status.signal(), Some(SIGKILL | SIGTERM));
        let record = ExitRecord::read(&lambda.exit_record()).ok();
        let is_in_lambda =
            |record: &ExitRecord| matches!(record.phase, Some(Phase::Init | Phase::Wake));
        killed
            && record
                .is_none_or(|it| it.killed.is_none() && !it.out_of_memory && !is_in_lambda(&it))
    }

    /// Returns how it has ended, with `status`. `requested` counts if its shim left no record.
    pub(crate) fn classify(
        &self,
        lambda: &LambdaSpec,
        status: ExitStatus,
        requested: bool,
    ) -> ProcessEnd {
        let record = ExitRecord::read(&lambda.exit_record()).ok();
        // A lambda can end its process as if that had been requested. The shim records whether it
        // was requested, and in time.
        let requested = record.as_ref().map_or(requested, |record| record.end_requested);
        match status.code().and_then(Exit::from_code) {
            // Ended before it could handle the signal.
            None if requested && !self.is_ready => ProcessEnd::Complete(Exit::Ok),
            Some(exit @ (Exit::Ok | Exit::LambdaFaulted)) if requested && self.has_ended => {
                ProcessEnd::Complete(exit)
            }
            // Our programs print an error before; another code is one that the lambda's code chose.
            Some(exit) if !self.is_ready && exit != Exit::Ok && self.error.message().is_some() => {
                // The shim records each end of a process that it has started, if it can: a full
                // disk must not hide that the lambda is at fault.
                let blameless = exit == Exit::Internal && record.is_none();
                ProcessEnd::NotStarted { exit, blameless }
            }
            _ => {
                let reason = match record.as_ref() {
                    Some(ExitRecord {
                        phase: Some(Phase::Init),
                        code: Some(code),
                        killed: None,
                        ..
                    }) => format!(
                        "the lambda's code ended its process with exit code {code} in its \
                         constructor"
                    ),
                    record => record.and_then(ExitRecord::sentence).map_or_else(
                        || ended("the lambda's process", status),
                        |reason| format!("the lambda's process {reason}"),
                    ),
                };
                let faulted =
                    self.has_faulted || record.is_some_and(|record| record.is_caused_by_lambda());
                ProcessEnd::Broken { reason, faulted }
            }
        }
    }
}
