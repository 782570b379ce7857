//! A recorder that is fed live: nothing that it is told waits for a disk.

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

/// How much later than its stamp a wake may come: a lambda's process sends them together, see
/// [`gleaner_protocol::link::RecorderLink::wake`]. Clips wait for them.
const GRACE: Duration = Duration::from_millis(200);

/// How many clips were deleted to make room, and how many could not be.
pub(crate) fn counted(losses: &[Loss]) -> (u64, u64) {
    let count = |is_it: fn(&Loss) -> bool| losses.iter().filter(|loss| is_it(loss)).count() as u64;
    (
        count(|loss| matches!(loss, Loss::Deleted { .. })),
        count(|loss| matches!(loss, Loss::NotDeleted { .. })),
    )
}

impl Recorder {
    /// A recorder without topics and lambdas, that is fed while it happens. A thread writes its
    /// clips; at most 16 MiB and one message are on their way to it, and the preroll holds what has
    /// to wait. Gaps in the numbers of samples are losses. What an earlier process left in a folder
    /// of [`RecordingFolder::hold`] is recovered by that thread, between what it has to write.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] as for [`Recorder::new`], and [`RecordError::Thread`].
    pub fn live(folder: RecordingFolder, settings: Settings) -> Result<Recorder, RecordError> {
        let mut recorder = Recorder::with(ClipWriter::background(folder)?, settings, true)?;
        recorder.windows.set_grace(nanoseconds(GRACE));
        Ok(recorder)
    }

    /// Does a piece of what is to be done, which takes a tenth of a millisecond or two unless a
    /// single message takes longer. To be called after every few samples and wakes, and again while
    /// it says so.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the preroll is on disk and that fails, or the thread that writes is gone.
    /// That a clip could not be written is no such error: see [`Recorder::take_failures`].
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

    /// Why clips could not be written since this was asked last; the first of them, 16 at most.
    pub fn take_failures(&mut self) -> Vec<RecordError> {
        std::mem::take(&mut self.finished.failures)
    }

    /// Clips that an earlier process had left unfinished, and that are whole now, since this was
    /// asked last. One that cannot be recovered is among the failures.
    pub fn take_recovered(&mut self) -> Vec<Clip> {
        std::mem::take(&mut self.finished.recovered)
    }

    /// Clips that had to go for others, or could not be deleted, since this was asked last; the
    /// first of them.
    pub fn take_deleted(&mut self) -> Vec<Loss> {
        std::mem::take(&mut self.finished.deleted)
    }

    /// Whether a clip is open.
    pub fn is_recording(&self) -> bool {
        self.open_clip.is_some()
    }

    /// A topic that was missing is there.
    ///
    /// # Errors
    ///
    /// [`RecordError::LongTopic`] if a clip has no room for what it says of itself: it stays
    /// missing.
    pub fn found_topic(&mut self, id: TopicId, topic: TopicSchema) -> Result<(), RecordError> {
        topic.check()?;
        let now = self.now;
        let topic_state = &mut self.state.context.topics[id.0];
        if topic_state.is_missing {
            // Messages and windows know it by the name under which it was wanted.
            topic_state.topic =
                Arc::new(TopicSchema { name: topic_state.topic.name.clone(), ..topic });
            (topic_state.is_missing, topic_state.found_at) = (false, now);
        }
        Ok(())
    }

    /// So many wakes of a lambda were lost before they came here; the next one to come is of this
    /// stamp.
    pub fn lost_wakes(&mut self, lambda: LambdaId, at_ns: i64, count: u64) {
        self.state.context.lambdas[lambda.0].wakes += count;
        self.state.wake_losses[lambda.0].lost.add_some(at_ns, 0, count);
    }

    /// A sample came as far as here, and there was no room for it.
    pub fn lost_sample(&mut self, topic: TopicId, meta: &SampleMeta) {
        self.state.note_gap(topic.0, meta);
        self.state.losses[topic.0].lost.add(meta.at_ns, 0);
    }

    /// Somebody commands what `lambda` could trigger; `source` says who, in words. It is no wake:
    /// no journal has it, and it has no part in the lambda's cooldown. A stop ends what a command
    /// started with this label.
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

    /// A lambda has ended: what it started and did not stop ends now.
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

    /// From now on no clip is begun, and the one that is open ends: `why` says it. A preroll on
    /// disk gets smaller. `None`: goes on.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn hold(&mut self, why: Option<&str>) -> Result<(), RecordError> {
        self.held = why.map(Arc::from);
        self.state.preroll.shrink(why.is_some());
        // What is open ends at once.
        self.windows.set_grace(if why.is_some() { 0 } else { nanoseconds(GRACE) });
        self.run()
    }

    /// Whether nothing is to be recorded for now.
    pub fn is_held(&self) -> bool {
        self.held.is_some()
    }

    /// The preroll may take more from now on: `bytes`, and a disk if it was in memory. It is never
    /// made smaller.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if it has no place on the disk.
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

    /// The longest clip is as long from now on, if that is longer than before.
    pub fn grow_length(&mut self, most: Duration) {
        self.max_length_ns = self.max_length_ns.max(nanoseconds(most));
        self.windows.grow_length(self.max_length_ns);
    }

    /// Does everything that can be decided, however long it takes.
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
