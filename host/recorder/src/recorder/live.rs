//! The live part of a recorder: no call waits for a disk.

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::nanoseconds;
use gleaner_lambda::manifest::Store;
use gleaner_lambda::{Clip, Moment, Trigger};
use gleaner_protocol::link::Loss;
use gleaner_transport::SampleMeta;

use super::backfill::Budget;
use super::clip_writer::{ClipOutcome, ClipWriter};
use super::finished::KEPT;
use super::{Commanded, LambdaId, Recorder, Settings, TopicId, Work};
use crate::RecordError;
use crate::file::{RecordingFolder, TopicSchema};
use crate::window::TriggerOutcome;

/// Greatest delay of a wake after its stamp: a lambda's process sends wakes in batches, see
/// [`gleaner_protocol::link::RecorderLink::wake`]. Clips wait for them.
const GRACE: Duration = Duration::from_millis(200);

/// Counts the clips that were deleted to make room, and those that could not be.
pub(crate) fn counted(losses: &[Loss]) -> (u64, u64) {
    let count = |is_it: fn(&Loss) -> bool| losses.iter().filter(|loss| is_it(loss)).count() as u64;
    (
        count(|loss| matches!(loss, Loss::Deleted { .. })),
        count(|loss| matches!(loss, Loss::NotDeleted { .. })),
    )
}

impl Recorder {
    /// A live recorder without topics and lambdas. A thread writes its clips; at most 16 MiB and
    /// one message are queued for it, and the preroll holds the rest. Gaps in sequence numbers are
    /// losses. If `folder` comes from [`RecordingFolder::open_without_recovery`], that thread also
    /// recovers the unfinished clips of an earlier process, between its jobs.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] as for [`Recorder::new`], and [`RecordError::Thread`].
    pub fn live(folder: RecordingFolder, settings: Settings) -> Result<Recorder, RecordError> {
        let mut recorder = Recorder::with(ClipWriter::background(folder)?, settings, true)?;
        recorder.windows.set_grace(nanoseconds(GRACE));
        Ok(recorder)
    }

    /// Does a piece of the pending work, which takes 0.1 to 0.2 ms unless a single message takes
    /// longer. To be called after every few samples and wakes, and again while it returns
    /// [`Work::More`].
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the preroll is on disk and that fails, or if the writer thread has ended.
    /// A clip that could not be written is no such error: see [`Recorder::take_failures`].
    pub fn work(&mut self) -> Result<Work, RecordError> {
        let mut outcomes = Vec::new();
        self.state.context.writer.poll(&mut outcomes)?;
        self.note(outcomes);
        self.run_within(Budget::STEP)?;
        if self.is_settled() {
            return Ok(Work::Done);
        }
        Ok(if self.state.context.writer.has_room() { Work::More } else { Work::Wait })
    }

    /// Takes the errors of clips that could not be written since the last call; the first 16.
    pub fn take_failures(&mut self) -> Vec<RecordError> {
        std::mem::take(&mut self.finished.failures)
    }

    /// Takes the clips of an earlier process that were recovered since the last call. One that
    /// cannot be recovered is among the failures.
    pub fn take_recovered(&mut self) -> Vec<Clip> {
        std::mem::take(&mut self.finished.recovered)
    }

    /// Takes the clips that were deleted to make room, or could not be deleted, since the last
    /// call; the first of them.
    pub fn take_deleted(&mut self) -> Vec<Loss> {
        std::mem::take(&mut self.finished.deleted)
    }

    /// Returns whether a clip is open.
    pub fn is_recording(&self) -> bool {
        self.open_clip.is_some()
    }

    /// Adds the description of a topic that was missing until now.
    ///
    /// # Errors
    ///
    /// [`RecordError::LongTopic`] if a clip has no room for its description: it stays missing.
    pub fn found_topic(&mut self, id: TopicId, topic: TopicSchema) -> Result<(), RecordError> {
        topic.check()?;
        let now = self.now;
        let topic_state = &mut self.state.context.topics[id.0];
        if topic_state.is_missing {
            // Messages and windows use the name with which it was requested.
            topic_state.topic =
                Arc::new(TopicSchema { name: topic_state.topic.name.clone(), ..topic });
            (topic_state.is_missing, topic_state.found_at) = (false, now);
        }
        Ok(())
    }

    /// Counts wakes of a lambda that did not arrive; `at_ns` is the stamp of the next one that
    /// does.
    pub fn lost_wakes(&mut self, lambda: LambdaId, at_ns: i64, count: u64) {
        self.state.context.lambdas[lambda.0].wakes += count;
        self.state.wake_losses[lambda.0].lost.add_some(at_ns, 0, count);
    }

    /// Counts a sample that arrived without room for it.
    pub fn lost_sample(&mut self, topic: TopicId, meta: &SampleMeta) {
        self.state.note_gap(topic.0, meta);
        self.state.losses[topic.0].lost.add(meta.at_ns, 0);
    }

    /// Executes a command in the name of `lambda`; `source` describes who gave it. It is not a
    /// wake: it is in no journal, and has no effect on the lambda's cooldown. A stop ends only a
    /// recording that a command started with this label.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn command(
        &mut self,
        lambda: LambdaId,
        trigger: &Trigger,
        at_ns: i64,
        source: String,
    ) -> Result<Commanded, RecordError> {
        if self.held.is_some() {
            self.counts.recording.disk_suppressed += 1;
            return Ok(Commanded::DiskSuppressed);
        }
        let commanded = match self.windows.command(lambda.0, trigger.kind, &trigger.label, at_ns) {
            TriggerOutcome::Opened => {
                self.counts.recording.windows += 1;
                Commanded::Opened
            }
            TriggerOutcome::Stopped => Commanded::Stopped,
            TriggerOutcome::InCooldown
            | TriggerOutcome::Ignored
            | TriggerOutcome::TooManyStarted
            | TriggerOutcome::TooManyWaiting => {
                return Ok(Commanded::Ignored);
            }
        };
        let moment =
            Moment { source: Some(source), ..Moment::of(self.name_of(lambda), trigger, at_ns) };
        self.await_clip(lambda, moment);
        self.act()?;
        Ok(commanded)
    }

    /// Ends a lambda, and the recordings that it started and did not stop.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn end_lambda(&mut self, lambda: LambdaId, at_ns: i64) -> Result<(), RecordError> {
        if self.windows.end(lambda.0, at_ns)
            && let Some(open_clip) = &mut self.open_clip
            && !open_clip.ended.contains(&lambda.0)
        {
            open_clip.ended.push(lambda.0);
        }
        self.run()
    }

    /// Suspends recording: no clip is begun, and the open one ends with the reason `why`. A preroll
    /// on disk shrinks. `None` resumes.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn hold(&mut self, why: Option<&str>) -> Result<(), RecordError> {
        self.held = why.map(Arc::from);
        self.state.preroll.shrink(why.is_some());
        // The open clip ends at once.
        self.windows.set_grace(if why.is_some() { 0 } else { nanoseconds(GRACE) });
        self.run()
    }

    /// Returns whether recording is suspended.
    pub fn is_held(&self) -> bool {
        self.held.is_some()
    }

    /// Raises the bound of the preroll to `bytes`, and moves it to disk if `store` is the disk. It
    /// never shrinks.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if there is no room on the disk.
    pub fn grow_preroll(&mut self, store: Store, bytes: u64) -> Result<(), RecordError> {
        let Settings { folder, prefault, .. } = &self.settings;
        if bytes <= self.counts.preroll_bound && store != Store::Disk {
            return Ok(());
        }
        let bytes = bytes.max(self.counts.preroll_bound);
        if self.state.preroll.grow(store, bytes, folder.join("preroll"), *prefault)? {
            if let Some(backfill) = &mut self.backfill {
                backfill.restart();
            }
            if let Some(behind) = &mut self.behind {
                *behind = None;
            }
            if let Some(open_clip) = &mut self.open_clip {
                open_clip.settled = None;
            }
        }
        self.counts.preroll_bound = bytes;
        Ok(())
    }

    /// Raises the length of the longest clip.
    pub fn grow_length(&mut self, most: Duration) {
        self.max_length_ns = self.max_length_ns.max(nanoseconds(most));
        self.windows.grow_length(self.max_length_ns);
    }

    /// Does all pending work, however long it takes.
    pub(super) fn settle_all(&mut self) -> Result<(), RecordError> {
        loop {
            self.run_within(Budget::ALL)?;
            if self.is_settled() {
                return Ok(());
            }
            self.wait()?;
        }
    }

    /// Waits until everything is written.
    pub(super) fn drain(&mut self) -> Result<(), RecordError> {
        while !self.state.context.writer.is_idle() {
            self.wait()?;
        }
        Ok(())
    }

    fn wait(&mut self) -> Result<(), RecordError> {
        let mut outcomes = Vec::new();
        self.state.context.writer.wait(&mut outcomes)?;
        self.note(outcomes);
        Ok(())
    }

    fn note_deleted(&mut self, deleted: Vec<Loss>) {
        let (gone, stuck) = counted(&deleted);
        self.counts.recording.deleted += gone;
        self.counts.recording.not_deleted += stuck;
        self.finished.deleted.extend(deleted);
        self.finished.deleted.truncate(KEPT);
    }

    fn note(&mut self, outcomes: Vec<ClipOutcome>) {
        for outcome in outcomes {
            match outcome {
                ClipOutcome::Finished(clip, deleted) => {
                    self.finished.add(Some(*clip));
                    self.note_deleted(deleted);
                }
                ClipOutcome::Recovered(clip, deleted) => {
                    self.finished.recovered.push(*clip);
                    self.note_deleted(deleted);
                }
                ClipOutcome::Failed(error) => {
                    self.counts.recording.failed += 1;
                    self.finished.fail(error);
                }
            }
        }
    }
}
