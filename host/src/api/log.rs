//! Lines for people: cut, rate-limited, and every dropped one counted.

use gleaner_journal::Said;
use gleaner_lambda::manifest::Limits;
pub use gleaner_lambda::{LogLevel as Level, LogLine as Line};
pub use gleaner_rules::log::LINE_BYTES;
use gleaner_rules::log::{Rate, line};
pub use gleaner_rules::text::cut;

use super::Session;
use super::fuel::OutOfFuel;

pub(super) struct Log {
    lines: Vec<Line>,
    rate: Rate,
    /// Lines since the last call of `take`, those included that were dropped, and the CRC-32 over
    /// them: how many the rate limit lets pass depends on wakes before.
    said: Said,
}

impl Log {
    pub(super) fn new(limits: &Limits) -> Self {
        let rate = Rate::new(limits.log_lines, limits.log_bytes.bytes());
        Self { lines: Vec::new(), rate, said: Said::default() }
    }

    pub(super) fn take(&mut self) -> (Vec<Line>, Said) {
        (std::mem::take(&mut self.lines), std::mem::take(&mut self.said))
    }

    pub(super) fn dropped(&self) -> u64 {
        self.rate.dropped()
    }

    /// The lines behind the first `n`, which stay, and what a journal notes of all.
    pub(super) fn behind(&self, n: usize) -> (&[Line], Said) {
        (self.lines.get(n..).unwrap_or_default(), self.said)
    }

    /// Adds what was counted in another process, where the lines were written.
    pub(super) fn relay(&mut self, said: Said, dropped: u64) {
        self.said = said;
        self.rate.add_dropped(dropped);
    }

    fn write(&mut self, at_ns: i64, level: Level, message: &str) {
        let message = line(message);
        let mut digest = crc32fast::Hasher::new_with_initial(self.said.digest);
        digest.update(&[level as u8]);
        digest.update(&(message.len() as u64).to_le_bytes());
        digest.update(message.as_bytes());
        self.said = Said { lines: self.said.lines.saturating_add(1), digest: digest.finalize() };
        if self.rate.keeps(at_ns, message) {
            self.lines.push(Line { at_ns, level, message: message.to_owned() });
        }
    }

    /// Each text once in a second, beside what the lambda may write, and no part of what it said.
    fn note(&mut self, at_ns: i64, text: &'static str) {
        if self.rate.notes(at_ns, text) {
            self.lines.push(Line { at_ns, level: Level::Warn, message: text.to_owned() });
        }
    }
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

    /// The host says something about the lambda, as a warning at the time of this wake; the same
    /// thing once in a second.
    pub fn note(&self, text: &'static str) {
        let mut state = self.lock();
        let at_ns = state.now_ns;
        state.log.note(at_ns, text);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
