//! The live part of a recorder: no call waits for a disk.

use std::time::Duration;

use gleaner_base::nanoseconds;
use gleaner_lambda::manifest::Store;
use gleaner_lambda::{Clip, Moment, Trigger};
use gleaner_protocol::link::Loss;

use super::clips::Budget;
use super::writer::ClipDisk;
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
        let unsigned = folder.unsigned();
        let disk = ClipDisk::background(folder)?;
        let mut recorder = Recorder::with(disk, settings, unsigned, true)?;
        recorder.clips.windows.set_grace(nanoseconds(GRACE));
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
        self.clips.progress.poll()?;
        self.clips.run_within(Budget::STEP, &mut self.material)?;
        if self.clips.progress.is_settled() {
            return Ok(Work::Done);
        }
        Ok(if self.clips.progress.has_room() { Work::More } else { Work::Wait })
    }

    /// Takes the errors of clips that could not be written since the last call; the first 16.
    pub fn take_failures(&mut self) -> Vec<RecordError> {
        self.clips.progress.finished.take_failures()
    }

    /// Takes the clips of an earlier process that were recovered since the last call. One that
    /// cannot be recovered is among the failures.
    pub fn take_recovered(&mut self) -> Vec<Clip> {
        self.clips.progress.finished.take_recovered()
    }

    /// Takes the clips that were deleted to make room, or could not be deleted, since the last
    /// call; the first of them.
    pub fn take_deleted(&mut self) -> Vec<Loss> {
        self.clips.progress.finished.take_deleted()
    }

    /// Returns whether a clip is open.
    pub fn is_recording(&self) -> bool {
        self.clips.progress.is_open()
    }

    /// Adds the description of a topic that was missing; its samples arrive since `since_ns`.
    ///
    /// # Errors
    ///
    /// [`RecordError::LongTopic`] if a clip has no room for its description: it stays missing.
    pub fn found_topic(
        &mut self,
        id: TopicId,
        topic: TopicSchema,
        since_ns: i64,
    ) -> Result<(), RecordError> {
        self.material.sources.found_topic(id.0, topic, since_ns)
    }

    /// Counts wakes of a lambda that did not arrive; `at_ns` is the stamp of the next one that
    /// does.
    pub fn lost_wakes(&mut self, lambda: LambdaId, at_ns: i64, count: u64) {
        self.material.sources.count_wakes(lambda.0, count);
        self.material.history.lost_wakes(lambda.0, at_ns, count);
    }

    /// Notes that the ingress has ended at `at_ns` or later, or that another one was joined then.
    /// Clips state the time in between. `now_ns` is the current time: all samples of the earlier
    /// ingress are stamped before.
    pub fn note_ingress(&mut self, at_ns: i64, now_ns: i64, is_there: bool) {
        self.material.history.note_ingress(at_ns, now_ns, is_there);
    }

    /// Executes a command in the name of `lambda`; `source` describes who gave it. It is not a
    /// wake: it is in no journal, and has no effect on the lambda's cooldown. A stop ends only a
    /// recording that a command started with this label.
    pub fn command(
        &mut self,
        lambda: LambdaId,
        trigger: &Trigger,
        at_ns: i64,
        source: String,
    ) -> Result<Commanded, RecordError> {
        if self.clips.is_held() {
            self.clips.count_suppressed(1);
            return Ok(Commanded::DiskSuppressed);
        }
        let (kind, label) = (trigger.kind, &trigger.label);
        let commanded = match self.clips.windows.command(lambda.0, kind, label, at_ns) {
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
        let name = self.material.sources.name(lambda.0);
        let moment = Moment { source: Some(source), ..Moment::of(name, trigger, at_ns) };
        self.clips.await_clip(lambda.0, moment);
        self.clips.act(&mut self.material)?;
        Ok(commanded)
    }

    /// Replaces the engine of a lambda. Clips that end later state it.
    pub fn set_engine(&mut self, lambda: LambdaId, engine: String) {
        self.material.sources.set_engine(lambda.0, engine);
    }

    /// Ends a lambda, and the recordings that it started and did not stop.
    pub fn end_lambda(&mut self, lambda: LambdaId, at_ns: i64) -> Result<(), RecordError> {
        self.clips.end_lambda(lambda.0, at_ns, &mut self.material)
    }

    /// Suspends recording: no clip is begun, and the open one ends with the reason `why`. A preroll
    /// on disk shrinks. `None` resumes.
    pub fn hold(&mut self, why: Option<&str>) -> Result<(), RecordError> {
        self.material.history.preroll.shrink(why.is_some());
        // The open clip ends at once.
        self.clips.hold(why, if why.is_some() { 0 } else { nanoseconds(GRACE) });
        self.clips.run(&mut self.material)
    }

    /// Returns whether recording is suspended.
    pub fn is_held(&self) -> bool {
        self.clips.is_held()
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
        let folder = folder.join("preroll");
        if self.material.history.preroll.grow(store, bytes, folder, *prefault)? {
            self.clips.progress.preroll_moved();
        }
        self.counts.preroll_bound = bytes;
        Ok(())
    }

    /// Raises the length of the longest clip.
    pub fn grow_length(&mut self, most: Duration) {
        self.clips.grow_length(nanoseconds(most));
    }
}
