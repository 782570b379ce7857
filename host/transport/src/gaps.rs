//! Losses that sequence numbers tell of.

use crate::transport::Guid;

/// Counts the samples that are missing between those that came, writer by writer.
#[derive(Debug, Default)]
pub struct Gaps {
    writers: Vec<(Guid, u64)>,
    lost: u64,
}

impl Gaps {
    /// A sample came. Returns how many are missing just before it.
    pub fn note(&mut self, writer: Guid, seq: u64) -> u64 {
        let Some((_, next)) = self.writers.iter_mut().find(|(known, _)| *known == writer) else {
            self.writers.push((writer, seq.saturating_add(1)));
            return 0;
        };
        let missing = seq.saturating_sub(*next);
        *next = (*next).max(seq.saturating_add(1));
        self.lost += missing;
        missing
    }

    /// How many are missing in all.
    pub fn lost(&self) -> u64 {
        self.lost
    }
}
