//! Clips that are finished. Their list is on disk: of many, only the newest are remembered.

use gleaner_protocol::Clip;

/// As many are remembered, and at times twice as many.
const KEPT: usize = 256;

#[derive(Debug, Default)]
pub(super) struct Finished {
    newest: Vec<Clip>,
    /// How many there were.
    pub(super) count: u64,
}

impl Finished {
    pub(super) fn add(&mut self, clip: Clip) {
        if self.newest.len() >= 2 * KEPT {
            self.newest.drain(..KEPT);
        }
        self.newest.push(clip);
        self.count += 1;
    }

    pub(super) fn newest(&self) -> &[Clip] {
        &self.newest
    }
}
