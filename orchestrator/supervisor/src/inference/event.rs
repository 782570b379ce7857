//! Events of the process.

use std::time::Duration;

use gleaner_protocol::inference::InferenceReport;

/// An event of the process, for the user.
pub enum InferenceEvent {
    /// One of its reports.
    Report(InferenceReport),
    /// A piece of its standard error.
    Stderr(Vec<u8>),
    /// It has ended without a request, for this reason, and is started again after the delay.
    Ended(String, Duration),
    /// Something else went wrong.
    Warning(String),
}
