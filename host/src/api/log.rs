//! Lines for people: cut, rate-limited, and every dropped one counted.

use gleaner_protocol::journal::Said;
use serde::Serialize;

use super::Session;

/// Lines that a lambda may write in one second of its own time.
pub const LINES_PER_SECOND: u32 = 100;

/// Longest line in bytes; the rest is cut at a character boundary.
pub const LINE_BYTES: usize = 4096;

/// How much a line matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
#[allow(missing_docs)]
pub enum Level {
    Error,
    Warn,
    Info,
    Debug,
    Trace,
}

/// One line that a lambda wrote.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Line {
    /// Time of the wake that wrote it, in nanoseconds.
    pub at_ns: i64,
    /// How much it matters.
    pub level: Level,
    /// The text, at most [`LINE_BYTES`] long.
    pub message: String,
}

#[derive(Default)]
pub(super) struct Log {
    lines: Vec<Line>,
    dropped: u64,
    /// Second of the lambda's time, and the lines written in it.
    window: (i64, u32),
    /// Lines since the last call of `take`, those included that were dropped, and the CRC-32 over them: how many the rate limit
    /// lets pass depends on wakes before.
    said: Said,
}

impl Log {
    pub(super) fn take(&mut self) -> (Vec<Line>, Said) {
        (std::mem::take(&mut self.lines), std::mem::take(&mut self.said))
    }

    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    fn write(&mut self, at_ns: i64, level: Level, message: &str) {
        let message = cut(message, LINE_BYTES);
        let mut digest = crc32fast::Hasher::new_with_initial(self.said.digest);
        digest.update(&[level as u8]);
        digest.update(&(message.len() as u64).to_le_bytes());
        digest.update(message.as_bytes());
        self.said = Said { lines: self.said.lines.saturating_add(1), digest: digest.finalize() };
        let second = at_ns.div_euclid(1_000_000_000);
        if self.window.0 != second {
            self.window = (second, 0);
        }
        if self.window.1 >= LINES_PER_SECOND {
            self.dropped += 1;
            return;
        }
        self.window.1 += 1;
        self.lines.push(Line { at_ns, level, message: message.to_owned() });
    }
}

impl Session {
    /// Writes one line at the time of this wake.
    pub fn log(&self, level: Level, message: &str) {
        let mut state = self.lock();
        let at_ns = state.now_ns;
        state.log.write(at_ns, level, message);
    }
}

/// The longest start of `text` that fits into `bytes` and ends at a character boundary.
pub fn cut(text: &str, bytes: usize) -> &str {
    &text[..text.floor_char_boundary(bytes)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_dropped_and_counted_until_the_next_second() {
        let mut log = Log::default();
        for _ in 0..250 {
            log.write(10, Level::Info, "x");
        }
        log.write(1_000_000_000, Level::Info, "y");
        assert_eq!(log.dropped(), 150);
        assert_eq!(log.take().0.len(), 101);
    }

    #[test]
    fn a_long_line_is_cut_between_characters() {
        assert_eq!(cut("aé", 2), "a");
        assert_eq!(cut("aé", 3), "aé");
        assert_eq!(cut("", 3), "");
    }
}
