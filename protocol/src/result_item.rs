//! The messages from the process of a live lambda to `gleaner-shim`.

use serde::{Deserialize, Serialize};

use crate::LiveStatus;
use gleaner_lambda::manifest::{Manifest, ScheduleSpec};
use gleaner_lambda::{Cause, Decision, LogLine};

/// The environment variable with the file descriptor of the pipe on which a live lambda's process
/// sends result items to `gleaner-shim`.
pub const RESULTS_ENV: &str = "GLEANER_RESULTS";

/// A message from a live lambda's process to `gleaner-shim`, which writes the result files: one
/// line of JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResultItem {
    /// Sent once, first, before the lambda is entered.
    Woken(WokenBy),
    /// A decision.
    Decision(Box<Decision>),
    /// A log line.
    Log(LogLine),
    /// Sent once, last: the summary. Its `unwritten` lacks the losses of the shim.
    Last(Box<LiveStatus>),
}

/// The schedule of a lambda: all that is known of a wake that ended with its process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WokenBy {
    /// A sample or the clock.
    pub cause: Cause,
    /// Name of the input; `None` for the clock.
    pub input: Option<String>,
    /// Topic of the input; `None` for the clock.
    pub topic: Option<String>,
}

impl WokenBy {
    /// Returns the schedule of `manifest`.
    pub fn schedule_of(manifest: &Manifest) -> Self {
        let ScheduleSpec::Event { input: name, .. } = &manifest.schedule else {
            return Self { cause: Cause::Tick, input: None, topic: None };
        };
        let input = manifest.inputs.iter().find(|input| input.name == *name);
        Self {
            cause: Cause::Event,
            input: Some(name.to_string()),
            topic: input.map(|input| input.topic.to_string()),
        }
    }
}
