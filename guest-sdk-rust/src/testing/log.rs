//! Implements `gleaner:lambda/log`: truncates lines, and drops and counts those over the limits of
//! a second.

use gleaner_rules::log::{Rate, line};

use super::manifest::Limits;
use super::session::current;
pub use crate::bindings::gleaner::lambda::log::Level;

/// One line of the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLine {
    /// Time of the wake that wrote it, in nanoseconds; 0 before the first wake.
    pub at_ns: i64,
    /// Severity of the line.
    pub level: Level,
    /// The text, at most 4,096 bytes.
    pub message: String,
}

pub(crate) fn log(level: Level, message: &str) {
    let session = current();
    session.check_bytes(message.len());
    let mut state = session.lock();
    let at_ns = state.now_ns;
    state.log.write(at_ns, level, message);
}

/// All lines of a run.
pub(super) struct Log {
    pub(super) lines: Vec<LogLine>,
    rate: Rate,
}

impl Log {
    pub(super) fn new(limits: &Limits) -> Self {
        Self { lines: Vec::new(), rate: Rate::new(limits.log_lines, limits.log_bytes) }
    }

    pub(super) fn dropped(&self) -> u64 {
        self.rate.dropped()
    }

    fn write(&mut self, at_ns: i64, level: Level, message: &str) {
        let message = line(message);
        if self.rate.keeps(at_ns, message) {
            self.lines.push(LogLine { at_ns, level, message: message.to_owned() });
        }
    }

    /// Writes a line of the host itself.
    pub(super) fn note(&mut self, at_ns: i64, text: &'static str) {
        if self.rate.notes(at_ns, text) {
            self.lines.push(LogLine { at_ns, level: Level::Warn, message: text.to_owned() });
        }
    }
}
