//! How much a lambda may write to its log.

use crate::text::cut;

/// Longest line in bytes; the rest is cut at a character boundary.
pub const LINE_BYTES: usize = 4096;

const SECOND_NS: i64 = 1_000_000_000;

/// What was written in a second of the lambda's time, and what was dropped so far.
#[derive(Debug)]
pub struct Rate {
    lines_per_second: u64,
    bytes_per_second: u64,
    /// The second in which was written last, and how many lines and bytes.
    window: (i64, u64, u64),
    /// What the host noted in a second.
    notes: (i64, Vec<&'static str>),
    dropped: u64,
}

impl Rate {
    /// Nothing was written yet.
    pub fn new(lines_per_second: u64, bytes_per_second: u64) -> Self {
        let (window, notes) = Default::default();
        Self { lines_per_second, bytes_per_second, window, notes, dropped: 0 }
    }

    /// Returns whether one more line is kept, which was cut before; else it is counted.
    pub fn keeps(&mut self, at_ns: i64, line: &str) -> bool {
        let second = at_ns.div_euclid(SECOND_NS);
        if self.window.0 != second {
            self.window = (second, 0, 0);
        }
        let (_, lines, bytes) = &mut self.window;
        let with_it = bytes.saturating_add(line.len() as u64);
        if *lines >= self.lines_per_second || with_it > self.bytes_per_second {
            self.dropped += 1;
            return false;
        }
        (*lines, *bytes) = (*lines + 1, with_it);
        true
    }

    /// Returns whether the host says this now: each text once in a second, beside what the lambda
    /// may write.
    pub fn notes(&mut self, at_ns: i64, text: &'static str) -> bool {
        let second = at_ns.div_euclid(SECOND_NS);
        if self.notes.0 != second {
            self.notes = (second, Vec::new());
        }
        let is_new = !self.notes.1.contains(&text);
        if is_new {
            self.notes.1.push(text);
        }
        is_new
    }

    /// Lines that were dropped, since the start.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Adds lines that were dropped in another process.
    pub fn add_dropped(&mut self, dropped: u64) {
        self.dropped = self.dropped.saturating_add(dropped);
    }
}

/// A line as it is kept at most.
pub fn line(message: &str) -> &str {
    cut(message, LINE_BYTES)
}
