//! A log line of a lambda, with its severity.

use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogLevel {
    Error,
    Warn,
    Info,
    Debug,
    Trace,
}

/// A line that a lambda logged: one line of `log.jsonl`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogLine {
    /// Time of the wake that logged it, in ns.
    pub at_ns: i64,
    pub level: LogLevel,
    /// The text, cut by the host to a maximum length.
    pub message: String,
}
