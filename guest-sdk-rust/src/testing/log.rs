//! `gleaner:lambda/log`: lines are cut, and what is over the limits of a second is dropped and counted.

use super::manifest::Limits;
use super::session::current;

/// Longest line in bytes; the rest is cut at a character boundary.
pub(super) const LINE_BYTES: usize = 4096;

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
    pub(super) dropped: u64,
    lines_per_second: u64,
    bytes_per_second: u64,
    /// The second in which was written last, and how many lines and bytes.
    window: (i64, u64, u64),
    /// What the host noted in a second.
    notes: (i64, Vec<&'static str>),
}

impl Log {
    pub(super) fn new(limits: &Limits) -> Self {
        let (lines_per_second, bytes_per_second) = (limits.log_lines, limits.log_bytes);
        let (window, notes) = Default::default();
        Self { lines: Vec::new(), dropped: 0, lines_per_second, bytes_per_second, window, notes }
    }

    fn write(&mut self, at_ns: i64, level: Level, message: &str) {
        let message = cut(message, LINE_BYTES);
        let second = second(at_ns);
        if self.window.0 != second {
            self.window = (second, 0, 0);
        }
        let (_, lines, bytes) = &mut self.window;
        let with_it = bytes.saturating_add(message.len() as u64);
        if *lines >= self.lines_per_second || with_it > self.bytes_per_second {
            self.dropped += 1;
            return;
        }
        (*lines, *bytes) = (*lines + 1, with_it);
        self.lines.push(Line { at_ns, level, message: message.to_owned() });
    }

    /// The host says something: the same thing once in a second.
    pub(super) fn note(&mut self, at_ns: i64, text: &'static str) {
        let second = second(at_ns);
        if self.notes.0 != second {
            self.notes = (second, Vec::new());
        }
        if !self.notes.1.contains(&text) {
            self.notes.1.push(text);
            self.lines.push(Line { at_ns, level: Level::Warn, message: text.to_owned() });
        }
    }
}

fn second(at_ns: i64) -> i64 {
    at_ns.div_euclid(1_000_000_000)
}

/// The longest start of `text` that fits into `bytes` and ends at a character boundary.
pub(super) fn cut(text: &str, bytes: usize) -> &str {
    &text[..text.floor_char_boundary(bytes)]
}
