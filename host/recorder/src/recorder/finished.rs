//! Clips that are finished. Their list is on disk: of many, only the newest are remembered.

use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;

use crate::RecordError;

/// As many are remembered, and at times twice as many.
pub(super) const KEPT: usize = 256;

/// Failures that wait to be asked for; of more, the first are told.
const FAILURES: usize = 16;

#[derive(Debug, Default)]
pub(super) struct Finished {
    newest: Vec<Clip>,
    /// How many there were.
    pub(super) count: u64,
    /// Why others could not be finished.
    pub(super) failures: Vec<RecordError>,
    /// What had to go for them, and was not yet asked for.
    pub(super) deleted: Vec<Loss>,
    /// Clips of an earlier process, which were not yet asked for.
    pub(super) recovered: Vec<Clip>,
}

impl Finished {
    /// Adds a clip, if it is known already.
    pub(super) fn add(&mut self, clip: Option<Clip>) {
        let Some(clip) = clip else { return };
        if self.newest.len() >= 2 * KEPT {
            self.newest.drain(..KEPT);
        }
        self.newest.push(clip);
        self.count += 1;
    }

    pub(super) fn fail(&mut self, error: RecordError) {
        if self.failures.len() < FAILURES {
            self.failures.push(error);
        }
    }

    pub(super) fn newest(&self) -> &[Clip] {
        &self.newest
    }
}
