//! The state of a supervised lambda: what becomes of its process next.

use std::time::{Duration, Instant};

use gleaner_protocol::LiveStatus;
use gleaner_protocol::supervision::LambdaPhase;

use crate::lambda_process::LambdaProcess;
use crate::revision_check::RevisionCheck;

pub(crate) enum LambdaState {
    /// To be started at this time.
    Due(Instant),
    /// Its files are being checked before a start.
    Checking(RevisionCheck),
    /// Its files are as signed: to be started at once.
    Checked,
    Running(Box<LambdaProcess>),
    /// It could not start, and is not started again.
    NotStarted,
    /// It failed too often, and is not started again.
    Quarantined,
    /// It has ended on request, with this last status.
    Ended(Option<Box<LiveStatus>>),
}

impl LambdaState {
    /// Returns its name for users.
    pub(crate) fn phase(&self) -> LambdaPhase {
        match self {
            Self::Due(_) | Self::Checked => LambdaPhase::Waiting,
            Self::Checking(_) => LambdaPhase::Checking,
            Self::Running(process) if !process.is_ready => LambdaPhase::Starting,
            Self::Running(_) => LambdaPhase::Running,
            Self::NotStarted | Self::Quarantined | Self::Ended(_) => LambdaPhase::Quarantined,
        }
    }

    /// Returns whether a process is to be started, at once or later.
    pub(crate) fn will_start(&self) -> bool {
        matches!(self, Self::Due(_) | Self::Checking(_) | Self::Checked)
    }

    /// Returns the time until a process is to be started; `None` if none is, or if a check comes
    /// before.
    pub(crate) fn due_in(&self) -> Option<Duration> {
        let Self::Due(at) = self else { return None };
        Some(at.saturating_duration_since(Instant::now()))
    }
}
