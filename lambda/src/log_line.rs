use serde::{Deserialize, Serialize};

/// How much a line of the log matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[allow(missing_docs)]
pub enum LogLevel {
    Error,
    Warn,
    Info,
    Debug,
    Trace,
}

/// One line that a lambda logged: one line of `log.jsonl`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogLine {
    /// Time of the wake that wrote it, in nanoseconds.
    pub at_ns: i64,
    /// How much it matters.
    pub level: LogLevel,
    /// The text, cut to a bound by the host.
    pub message: String,
}
