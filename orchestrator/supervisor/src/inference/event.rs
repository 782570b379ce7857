//! Events of the process.

use std::time::Duration;

use gleaner_protocol::inference::InferenceReport;

pub enum InferenceEvent {
    Report(InferenceReport),
    /// A piece of its standard error.
    Stderr(Vec<u8>),
    /// It has ended without a request, for this reason, and is started again after the delay. True
    /// for a fault of its own, false if it was killed, stood still or could not be started.
    Ended(String, Duration, bool),
    /// A model is refused for the rest of the run, for this reason.
    Refused(String),
    /// Something else went wrong.
    Warning(String),
}
