//! Limits the rate of a lambda's log.

use crate::text::cut;

/// Longest line in bytes; the rest is cut at a character boundary.
pub const LINE_BYTES: usize = 4096;

const SECOND_NS: i64 = 1_000_000_000;

/// Counts log lines per second of the lambda's time, and dropped lines.
#[derive(Debug)]
pub struct Rate {
    lines_per_second: u64,
    bytes_per_second: u64,
    /// The second of the last line, with its number of lines and bytes.
    window: (i64, u64, u64),
    /// The second of the last note of the host, with the texts noted in it.
    notes: (i64, Vec<&'static str>),
    dropped: u64,
}

impl Rate {
    pub fn new(lines_per_second: u64, bytes_per_second: u64) -> Self {
        let (window, notes) = Default::default();
        Self { lines_per_second, bytes_per_second, window, notes, dropped: 0 }
    }

    /// Counts a line, which [`line()`] has cut to its maximum length. Returns whether it is kept;
    /// otherwise it is dropped.
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

    /// Returns whether the host logs `text` now: each text once a second, beyond the limits of the
    /// lambda.
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

    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Adds lines that were dropped in another process.
    pub fn add_dropped(&mut self, dropped: u64) {
        self.dropped = self.dropped.saturating_add(dropped);
    }
}

/// Cuts a line to its maximum length.
pub fn line(message: &str) -> &str {
    cut(message, LINE_BYTES)
}
