//! The state of a supervised lambda: what becomes of its process next.

use std::path::PathBuf;
use std::time::Instant;

use gleaner_base::Exit;
use gleaner_protocol::LiveStatus;
use gleaner_protocol::supervision::LambdaPhase;

use super::process::LambdaProcess;
use crate::revision_check::RevisionCheck;

pub(super) enum LambdaState {
    Due(Instant),
    /// Its files are being checked before a start.
    Checking(RevisionCheck),
    /// Its files are as signed: to be started at once, by the interpreter of the environment that
    /// was made of its wheels, if it has any.
    Checked(Option<PathBuf>),
    Running(Box<LambdaProcess>),
    /// To end for good, which no other state follows. It has left once it has no process.
    Stopping(Option<Box<LambdaProcess>>),
    /// It could not start, and is not started again.
    NotStarted,
    /// It is not started again, for this reason until that was reported.
    Quarantined(Option<String>),
    /// It has ended, on request or at the end of the run: with this exit code and last status.
    Ended(Exit, Option<Box<LiveStatus>>),
}

impl LambdaState {
    pub(super) fn phase(&self) -> LambdaPhase {
        match self {
            Self::Due(_) | Self::Checked(_) => LambdaPhase::Waiting,
            Self::Checking(_) => LambdaPhase::Checking,
            Self::Running(process) if !process.is_ready() => LambdaPhase::Starting,
            Self::Running(_) => LambdaPhase::Running,
            Self::Stopping(_) => LambdaPhase::Stopping,
            Self::NotStarted | Self::Quarantined(_) | Self::Ended(..) => LambdaPhase::Quarantined,
        }
    }

    pub(super) fn process(&self) -> Option<&LambdaProcess> {
        match self {
            Self::Running(process) | Self::Stopping(Some(process)) => Some(process),
            _ => None,
        }
    }

    pub(super) fn process_mut(&mut self) -> Option<&mut LambdaProcess> {
        match self {
            Self::Running(process) | Self::Stopping(Some(process)) => Some(process),
            _ => None,
        }
    }

    /// Takes the process. The caller enters the next state.
    pub(super) fn take_process(&mut self) -> Option<Box<LambdaProcess>> {
        if let Self::Stopping(process) = self {
            return process.take();
        }
        match std::mem::replace(self, Self::Ended(Exit::Ok, None)) {
            Self::Running(process) => Some(process),
            other => {
                *self = other;
                None
            }
        }
    }
}
