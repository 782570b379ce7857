//! Lines for people: cut, rate-limited, and every dropped one counted.

use gleaner_protocol::journal::Said;
use gleaner_protocol::manifest::Limits;
pub use gleaner_protocol::{LogLevel as Level, LogLine as Line};

use super::Session;
use super::fuel::OutOfFuel;

/// Longest line in bytes; the rest is cut at a character boundary.
pub const LINE_BYTES: usize = 4096;

pub(super) struct Log {
    lines: Vec<Line>,
    dropped: u64,
    /// What may be written in one second of the lambda's time.
    lines_per_second: u64,
    bytes_per_second: u64,
    window: Window,
    /// What the host noted in this second.
    notes: (i64, Vec<&'static str>),
    /// Lines since the last call of `take`, those included that were dropped, and the CRC-32 over them: how many the rate limit
    /// lets pass depends on wakes before.
    said: Said,
}

/// What was written in a second.
#[derive(Default)]
struct Window {
    second: i64,
    lines: u64,
    bytes: u64,
}

impl Log {
    pub(super) fn new(limits: &Limits) -> Self {
        Self {
            lines: Vec::new(),
            dropped: 0,
            lines_per_second: limits.log_lines,
            bytes_per_second: limits.log_bytes.bytes(),
            window: Window::default(),
            notes: (0, Vec::new()),
            said: Said::default(),
        }
    }

    pub(super) fn take(&mut self) -> (Vec<Line>, Said) {
        (std::mem::take(&mut self.lines), std::mem::take(&mut self.said))
    }

    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// The lines behind the first `n`, which stay, and what a journal notes of all.
    pub(super) fn behind(&self, n: usize) -> (&[Line], Said) {
        (self.lines.get(n..).unwrap_or_default(), self.said)
    }

    /// Adds what was counted in another process, where the lines were written.
    pub(super) fn relay(&mut self, said: Said, dropped: u64) {
        self.said = said;
        self.dropped = self.dropped.saturating_add(dropped);
    }

    fn write(&mut self, at_ns: i64, level: Level, message: &str) {
        let message = cut(message, LINE_BYTES);
        let mut digest = crc32fast::Hasher::new_with_initial(self.said.digest);
        digest.update(&[level as u8]);
        digest.update(&(message.len() as u64).to_le_bytes());
        digest.update(message.as_bytes());
        self.said = Said { lines: self.said.lines.saturating_add(1), digest: digest.finalize() };
        let second = second(at_ns);
        if self.window.second != second {
            self.window = Window { second, ..Window::default() };
        }
        let Window { lines, bytes, .. } = &mut self.window;
        let with_it = bytes.saturating_add(message.len() as u64);
        if *lines >= self.lines_per_second || with_it > self.bytes_per_second {
            self.dropped += 1;
            return;
        }
        (*lines, *bytes) = (*lines + 1, with_it);
        self.lines.push(Line { at_ns, level, message: message.to_owned() });
    }

    /// Each text once in a second, beside what the lambda may write, and no part of what it said.
    fn note(&mut self, at_ns: i64, text: &'static str) {
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

impl Session {
    /// Writes one line at the time of this wake.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn log(&self, level: Level, message: &str) -> Result<(), OutOfFuel> {
        self.fuel.charge(|| message.len())?;
        self.write(level, message);
        Ok(())
    }

    /// Writes one line that the lambda has paid for otherwise.
    pub(crate) fn write(&self, level: Level, message: &str) {
        let mut state = self.lock();
        let at_ns = state.now_ns;
        state.log.write(at_ns, level, message);
    }

    /// The host says something about the lambda, as a warning at the time of this wake; the same thing once in a second.
    pub fn note(&self, text: &'static str) {
        let mut state = self.lock();
        let at_ns = state.now_ns;
        state.log.note(at_ns, text);
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
        let mut log = Log::new(&Limits::default());
        for _ in 0..250 {
            log.write(10, Level::Info, "x");
        }
        log.write(1_000_000_000, Level::Info, "y");
        assert_eq!(log.dropped(), 150);
        assert_eq!(log.take().0.len(), 101);
    }

    #[test]
    fn bytes_are_limited_beside_lines() {
        let mut limits = Limits::default();
        limits.log_bytes = gleaner_protocol::manifest::ByteSize::kib(4);
        let mut log = Log::new(&limits);
        for _ in 0..5 {
            log.write(10, Level::Info, &"x".repeat(1000));
        }
        // A short one still has room.
        log.write(10, Level::Info, "y");
        assert_eq!((log.dropped(), log.take().0.len()), (1, 5));
    }

    #[test]
    fn what_the_host_notes_comes_once_in_a_second_and_is_nothing_that_the_lambda_said() {
        let mut log = Log::new(&Limits::default());
        for at_ns in [0, 1, 2_000_000_000] {
            log.note(at_ns, "made anew");
            log.note(at_ns, "paused");
        }
        let (lines, said) = log.take();
        assert_eq!((lines.len(), said), (4, Said::default()));
    }

    #[test]
    fn a_long_line_is_cut_between_characters() {
        assert_eq!(cut("aé", 2), "a");
        assert_eq!(cut("aé", 3), "aé");
        assert_eq!(cut("", 3), "");
    }
}
