//! The parts of journals in an open clip.

use super::{at, plural};
use crate::recorder::limits::RecorderLimits;
use crate::recorder::writer::JournalPart;

/// The wakes of all lambdas; those of lambdas without windows in the clip are dropped at its end.
#[derive(Default)]
pub struct ClipJournals {
    limits: RecorderLimits,
    /// By lambda.
    parts: Vec<JournalPart>,
    /// Approximate size of all parts.
    bytes: usize,
    /// Lambdas whose part is short because there was no room for all together.
    crowded: Vec<usize>,
    /// Wakes that the preroll evicted, by lambda.
    evicted: Vec<u64>,
    /// Wakes that did not reach the recorder, by lambda.
    undelivered: Vec<u64>,
}

impl ClipJournals {
    pub fn new(limits: RecorderLimits) -> ClipJournals {
        ClipJournals { limits, ..ClipJournals::default() }
    }

    pub fn push(&mut self, lambda: usize, number: u64, encoded: &[u8]) {
        let part = at(&mut self.parts, lambda);
        let (before, cut) = (part.bytes(), part.cut());
        let others = self.bytes - before;
        let left = self.limits.parts_bytes.saturating_sub(others);
        part.push(number, encoded, self.limits.part_bytes.min(left));
        self.bytes = others + part.bytes();
        if left < self.limits.part_bytes && part.cut() > cut && !self.crowded.contains(&lambda) {
            self.crowded.push(lambda);
        }
    }

    /// Approximate size in memory.
    #[cfg(test)]
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    pub fn evicted(&mut self, lambda: usize, count: u64) {
        *at(&mut self.evicted, lambda) += count;
    }

    /// Counts wakes that did not reach the recorder.
    pub fn undelivered(&mut self, lambda: usize, count: u64) {
        *at(&mut self.undelivered, lambda) += count;
    }

    /// Takes the wakes of a lambda, and notes which are missing.
    pub fn take(&mut self, lambda: usize, name: &str, short: &mut Vec<String>) -> JournalPart {
        let mut part = std::mem::take(at(&mut self.parts, lambda));
        let undelivered = *at(&mut self.undelivered, lambda);
        if undelivered > 0 {
            let wakes = plural(undelivered, "wake");
            short.push(format!(
                "the journal of {name} lacks {wakes}: lost in transit to the recorder"
            ));
            let apart = part.keep_run();
            if apart > 0 {
                let wakes = plural(apart, "more wake");
                short.push(format!("the journal of {name} lacks {wakes}: some between were lost"));
            }
        }
        let lost = *at(&mut self.evicted, lambda);
        if lost > 0 {
            short.push(format!(
                "the journal of {name} lacks {}: evicted from the preroll",
                plural(lost, "wake")
            ));
        }
        if part.cut() > 0 {
            let last = plural(part.cut(), "wake");
            let why = match self.crowded.contains(&lambda) {
                false => format!("longer than {} MiB", self.limits.part_bytes >> 20),
                true => format!(
                    "all journals together are longer than {} MiB",
                    self.limits.parts_bytes >> 20
                ),
            };
            short.push(format!("the journal of {name} lacks the last {last}: {why}"));
        }
        part
    }
}
