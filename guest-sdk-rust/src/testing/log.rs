//! `gleaner:lambda/log`: lines are cut, and what is over the limits of a second is dropped and
//! counted.

use gleaner_rules::log::{Rate, line};

use super::manifest::Limits;
use super::session::current;

/// How much a line matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Level {
    /// Someone must act.
    Error,
    /// Data or time was lost.
    Warn,
    /// A state changed.
    Info,
    /// For the lambda's author.
    Debug,
    /// For the lambda's author, in detail.
    Trace,
}

/// One line of the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// Time of the wake that wrote it, in nanoseconds; 0 before the first.
    pub at_ns: i64,
    /// How much it matters.
    pub level: Level,
    /// The text, 4,096 bytes at most.
    pub message: String,
}

pub(crate) fn log(level: Level, message: &str) {
    let session = current();
    session.passed(message.len());
    let mut state = session.lock();
    let at_ns = state.now_ns;
    state.log.write(at_ns, level, message);
}

/// All lines of a run.
pub(super) struct Log {
    pub(super) lines: Vec<Line>,
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
            self.lines.push(Line { at_ns, level, message: message.to_owned() });
        }
    }

    /// The host says something.
    pub(super) fn note(&mut self, at_ns: i64, text: &'static str) {
        if self.rate.notes(at_ns, text) {
            self.lines.push(Line { at_ns, level: Level::Warn, message: text.to_owned() });
        }
    }
}
