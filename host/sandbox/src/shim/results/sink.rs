//! The interface of a place for results.

use std::time::Duration;

use gleaner_base::Failure;
use gleaner_lambda::{Decision, LogLine};
use gleaner_protocol::{ExitRecord, LiveStatus};

/// A place for the results of one process of a lambda. After an error, later items are tried again.
pub(crate) trait ResultSink: Send {
    /// Returns the longest time that items may wait for [`flush`](Self::flush).
    fn interval(&self) -> Duration;

    /// Called once, before the lambda is entered.
    fn begin(&mut self) -> Result<(), Failure>;

    fn decision(&mut self, decision: Box<Decision>) -> Result<(), Failure>;

    fn log(&mut self, line: LogLine) -> Result<(), Failure>;

    fn has_pending(&self) -> bool;

    /// Returns whether too many items wait.
    fn is_due(&self) -> bool;

    /// Writes the waiting items. So far, `invalid` lines were not items.
    fn flush(&mut self, invalid: u64) -> Result<(), Failure>;

    /// Returns the number of items that were not written.
    fn lost(&self) -> u64;

    /// Completes the results with the end of the process, and with its summary if it was complete.
    fn finish(self: Box<Self>, end: ProcessResults<'_>) -> Result<(), Failure>;
}

/// The end of a process, for [`ResultSink::finish`].
pub(crate) struct ProcessResults<'a> {
    pub(crate) summary: Option<Box<LiveStatus>>,
    pub(crate) record: &'a ExitRecord,
    /// Number of lines that were not items.
    pub(crate) invalid: u64,
}
