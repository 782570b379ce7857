//! Finished clips. Their list is on disk: only the newest are kept in memory.

use gleaner_lambda::Clip;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::link::Loss;

use crate::RecordError;
use crate::recorder::counted;
use crate::recorder::writer::ClipOutcome;

/// Number of clips kept, and at times twice as many.
const KEPT: usize = 256;

/// Most failures kept until they are taken; of more, the first.
const FAILURES: usize = 16;

#[derive(Debug, Default)]
pub struct Finished {
    newest: Vec<Clip>,
    /// Counts of finished, failed and deleted clips.
    counts: RecordingCounts,
    failures: Vec<RecordError>,
    deleted: Vec<Loss>,
    recovered: Vec<Clip>,
}

impl Finished {
    pub fn add(&mut self, clip: Option<Clip>) {
        let Some(clip) = clip else { return };
        if self.newest.len() >= 2 * KEPT {
            self.newest.drain(..KEPT);
        }
        self.newest.push(clip);
        self.counts.clips += 1;
    }

    /// Adds what the writer thread has done.
    pub fn note(&mut self, outcomes: Vec<ClipOutcome>) {
        for outcome in outcomes {
            match outcome {
                ClipOutcome::Finished(clip, deleted) => {
                    self.add(Some(*clip));
                    self.note_deleted(deleted);
                }
                ClipOutcome::Recovered(clip, deleted) => {
                    self.recovered.push(*clip);
                    self.note_deleted(deleted);
                }
                ClipOutcome::Failed(error) => {
                    self.counts.failed += 1;
                    if self.failures.len() < FAILURES {
                        self.failures.push(error);
                    }
                }
            }
        }
    }

    fn note_deleted(&mut self, deleted: Vec<Loss>) {
        let (gone, stuck) = counted(&deleted);
        self.counts.deleted += gone;
        self.counts.not_deleted += stuck;
        self.deleted.extend(deleted);
        self.deleted.truncate(KEPT);
    }

    pub fn newest(&self) -> &[Clip] {
        &self.newest
    }

    pub fn counts(&self) -> &RecordingCounts {
        &self.counts
    }

    pub fn take_failures(&mut self) -> Vec<RecordError> {
        std::mem::take(&mut self.failures)
    }

    /// Takes the losses from making room.
    pub fn take_deleted(&mut self) -> Vec<Loss> {
        std::mem::take(&mut self.deleted)
    }

    pub fn take_recovered(&mut self) -> Vec<Clip> {
        std::mem::take(&mut self.recovered)
    }
}
