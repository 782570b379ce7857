//! Finished clips. Their list is on disk: only the newest are kept in memory.

use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;

use crate::RecordError;

/// Number of clips kept, and at times twice as many.
pub(super) const KEPT: usize = 256;

/// Most failures kept until they are taken; of more, the first.
const FAILURES: usize = 16;

#[derive(Debug, Default)]
pub(super) struct Finished {
    newest: Vec<Clip>,
    /// Number of finished clips.
    pub(super) count: u64,
    /// Errors of clips that could not be finished.
    pub(super) failures: Vec<RecordError>,
    /// Losses from making room, until they are taken.
    pub(super) deleted: Vec<Loss>,
    /// Recovered clips of an earlier process, until they are taken.
    pub(super) recovered: Vec<Clip>,
}

impl Finished {
    /// Adds a clip, if it is finished already.
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
