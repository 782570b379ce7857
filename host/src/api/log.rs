//! The log of a lambda: lines are truncated and rate-limited, and dropped ones counted.

use gleaner_journal::LogDigest;
use gleaner_lambda::manifest::Limits;
pub use gleaner_lambda::{LogLevel as Level, LogLine};
pub use gleaner_rules::log::LINE_BYTES;
use gleaner_rules::log::{Rate, line};
pub use gleaner_rules::text::cut;

use super::Session;
use super::fuel::OutOfFuel;

pub(super) struct Log {
    lines: Vec<LogLine>,
    rate: Rate,
    /// Number and CRC-32 of the lines since the last call of `take`, including dropped ones: how
    /// many pass the rate limit depends on earlier wakes.
    digest: LogDigest,
}

impl Log {
    pub(super) fn new(limits: &Limits) -> Self {
        let rate = Rate::new(limits.log_lines, limits.log_bytes.bytes());
        Self { lines: Vec::new(), rate, digest: LogDigest::default() }
    }

    pub(super) fn take(&mut self) -> (Vec<LogLine>, LogDigest) {
        (std::mem::take(&mut self.lines), std::mem::take(&mut self.digest))
    }

    pub(super) fn dropped(&self) -> u64 {
        self.rate.dropped()
    }

    /// Returns the lines after the first `n`, without removing them, and the digest of all lines.
    pub(super) fn behind(&self, n: usize) -> (&[LogLine], LogDigest) {
        (self.lines.get(n..).unwrap_or_default(), self.digest)
    }

    /// Takes over the digest and the number of dropped lines from the process that wrote the lines.
    pub(super) fn relay(&mut self, digest: LogDigest, dropped: u64) {
        self.digest = digest;
        self.rate.add_dropped(dropped);
    }

    fn write(&mut self, at_ns: i64, level: Level, message: &str) {
        let message = line(message);
        let mut digest = crc32fast::Hasher::new_with_initial(self.digest.digest);
        digest.update(&[level as u8]);
        digest.update(&(message.len() as u64).to_le_bytes());
        digest.update(message.as_bytes());
        self.digest =
            LogDigest { lines: self.digest.lines.saturating_add(1), digest: digest.finalize() };
        if self.rate.keeps(at_ns, message) {
            self.lines.push(LogLine { at_ns, level, message: message.to_owned() });
        }
    }

    /// Adds a warning of the host: each text once in a second, beside the lambda's own limit and
    /// not part of its digest.
    fn note(&mut self, at_ns: i64, text: &'static str) {
        if self.rate.notes(at_ns, text) {
            self.lines.push(LogLine { at_ns, level: Level::Warn, message: text.to_owned() });
        }
    }
}

impl Session {
    /// Writes one line at the time of this wake.
    pub fn log(&self, level: Level, message: &str) -> Result<(), OutOfFuel> {
        self.fuel.charge(|| message.len())?;
        self.write(level, message);
        Ok(())
    }

    /// Writes one line that was charged elsewhere.
    pub(crate) fn write(&self, level: Level, message: &str) {
        let mut state = self.lock();
        let at_ns = state.now_ns;
        state.log.write(at_ns, level, message);
    }

    /// Adds a warning of the host at the time of this wake; the same text once in a second.
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
    fn host_warnings_come_once_in_a_second_and_are_not_part_of_the_digest() {
        let mut log = Log::new(&Limits::default());
        for at_ns in [0, 1, 2_000_000_000] {
            log.note(at_ns, "made anew");
            log.note(at_ns, "paused");
        }
        let (lines, digest) = log.take();
        assert_eq!((lines.len(), digest), (4, LogDigest::default()));
    }
}
