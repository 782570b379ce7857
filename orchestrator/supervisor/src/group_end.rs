//! The end of the processes of a run.

use std::process::ExitStatus;

use gleaner_base::Exit;

use crate::process::ended;

pub(crate) enum GroupEnd {
    /// It ended on request, its time or its drive was over, or no lambda could start.
    Complete,
    /// The ingress or the recorder could not start; it has printed the cause.
    NotStarted(Exit),
    /// The ingress or the recorder failed after the start, for this reason.
    Broken(String),
}

impl GroupEnd {
    /// The end of a process that all others need. `is_first` is true if it was not ready before.
    pub(crate) fn of(name: &str, status: ExitStatus, is_first: bool) -> GroupEnd {
        match status.code().and_then(Exit::from_code) {
            // It has printed the cause.
            Some(exit) if is_first && exit != Exit::Ok => GroupEnd::NotStarted(exit),
            _ => GroupEnd::Broken(ended(name, status)),
        }
    }
}
