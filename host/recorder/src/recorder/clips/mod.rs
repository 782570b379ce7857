//! Clips: from windows to the open clip, and from it to finished ones.
//!
//! One clip is open at a time. Samples are written to it when they come, or later by a backfill
//! from the preroll; a late trigger makes a late clip beside it. [`Clips`] decides, by windows;
//! `progress` has the clips that are being made.

mod backfill;
mod finished;
mod open_clip;
mod progress;
mod waiting;

use std::sync::Arc;

use gleaner_lambda::Moment;
use gleaner_messages::transport::SampleMeta;

pub use self::backfill::Budget;
use self::open_clip::CloseReason;
pub use self::open_clip::OpenClip;
use self::progress::ClipsInProgress;
use super::RecorderContext;
use super::writer::ClipDisk;
use crate::RecordError;
use crate::window::{WindowStep, Windows};

/// Windows, the clips that are being made of them, and finished ones.
pub struct Clips {
    /// After a trigger or a command, [`Clips::act`] has to follow.
    pub windows: Windows,
    pub progress: ClipsInProgress,
    /// The reason why recording is suspended.
    held: Option<Arc<str>>,
    /// Triggers while recording is suspended.
    disk_suppressed: u64,
}

impl Clips {
    pub fn new(disk: ClipDisk, max_length_ns: i64, is_live: bool) -> Clips {
        Clips {
            windows: Windows::new(max_length_ns),
            progress: ClipsInProgress::new(disk, max_length_ns, is_live),
            held: None,
            disk_suppressed: 0,
        }
    }

    pub fn is_held(&self) -> bool {
        self.held.is_some()
    }

    pub fn disk_suppressed(&self) -> u64 {
        self.disk_suppressed
    }

    pub fn count_suppressed(&mut self, triggers: u64) {
        self.disk_suppressed += triggers;
    }

    /// Suspends recording, for the reason `why`; `None` resumes. Clips end `grace_ns` after their
    /// last window.
    pub fn hold(&mut self, why: Option<&str>, grace_ns: i64) {
        self.held = why.map(Arc::from);
        self.windows.set_grace(grace_ns);
    }

    pub fn grow_length(&mut self, most_ns: i64) {
        self.windows.grow_length(self.progress.grow_length(most_ns));
    }

    /// Advances time to `now`, which history knows already. Pending steps come before old entries
    /// are dropped, as they may need them.
    pub fn pass(&mut self, now: i64, material: &mut RecorderContext) -> Result<(), RecordError> {
        self.windows.pass(now);
        self.run(material)?;
        if self.progress.is_settled() {
            material.history.trim(self.windows.horizon())
        } else {
            Ok(())
        }
    }

    /// Writes a sample to the open clip, if it belongs there. Returns the group whose clip then has
    /// it, or 0.
    pub fn write(
        &mut self,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
        material: &RecorderContext,
    ) -> Result<u64, RecordError> {
        self.progress.write(topic, meta, cdr, &self.windows, material)
    }

    /// Keeps a wake for the journal of the open clip, if it belongs there. Returns the group whose
    /// clip then has it, or 0.
    pub fn wake(&mut self, lambda: usize, number: u64, at_ns: i64, encoded: &[u8]) -> u64 {
        self.progress.wake(lambda, number, at_ns, encoded, &self.windows)
    }

    pub fn await_clip(&mut self, lambda: usize, moment: Moment) {
        self.progress.await_clip(lambda, moment, &self.windows);
    }

    /// Acts on the triggers and commands that the windows have got.
    pub fn act(&mut self, material: &mut RecorderContext) -> Result<(), RecordError> {
        self.run(material)?;
        self.progress.gather(&self.windows);
        Ok(())
    }

    pub fn end_lambda(
        &mut self,
        lambda: usize,
        at_ns: i64,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        if self.windows.end(lambda, at_ns)
            && let Some(clip) = self.progress.open()
        {
            clip.lambda_ended(lambda);
        }
        self.run(material)
    }

    /// Does all pending work; live, long work is left for later.
    pub fn run(&mut self, material: &mut RecorderContext) -> Result<(), RecordError> {
        let budget = if self.progress.is_live { Budget::NONE } else { Budget::ALL };
        self.run_within(budget, material)
    }

    /// Does the pending work, with backfills as far as `budget` allows.
    pub fn run_within(
        &mut self,
        mut budget: Budget,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        let Clips { windows, progress, .. } = self;
        while progress.continue_backfill(&mut budget, windows, material)? && progress.has_room() {
            let held = self.held.clone();
            if held.is_some() {
                self.disk_suppressed += windows.forget_waiting();
            }
            let Some(step) = windows.step() else {
                // The part that a full clip left for the next one is in it by now.
                if let Some(why) = held
                    && let Some(group) = windows.close()
                {
                    let end = material.history.now().unwrap_or(group.from);
                    progress.complete(&group, CloseReason::Early(end, why), material)?;
                }
                break;
            };
            match step {
                WindowStep::Begin(joined) => progress.begin(joined, windows, material)?,
                WindowStep::Join { windows: joined, fresh_from: Some(from) } => {
                    progress.settle(joined, from, windows, material)?
                }
                // It covers nothing new so far, and its trigger is collected by the caller that
                // added it.
                WindowStep::Join { .. } => {}
                WindowStep::Roll { boundary, before } => {
                    progress.roll(boundary, &before, windows, material)?
                }
                WindowStep::Finish(group) => {
                    progress.complete(&group, CloseReason::Complete, material)?
                }
                WindowStep::Late(joined, group) => progress.begin_late(joined, *group, material)?,
            }
        }
        Ok(())
    }

    /// Ends the recording: completes open clips. Live, this waits for the disk.
    pub fn finish(&mut self, end: i64, material: &mut RecorderContext) -> Result<(), RecordError> {
        self.settle_all(material)?;
        while let Some(group) = self.windows.close() {
            let why = || Arc::from("the recording was stopped before the window ended");
            let close = match self.progress.is_live {
                true => CloseReason::Early(end, why()),
                false => CloseReason::EndOfDrive(end),
            };
            self.progress.complete(&group, close, material)?;
            self.run(material)?;
            self.settle_all(material)?;
        }
        while !self.progress.disk.is_idle() {
            self.progress.wait()?;
        }
        Ok(())
    }

    /// Does all pending work, however long it takes.
    fn settle_all(&mut self, material: &mut RecorderContext) -> Result<(), RecordError> {
        loop {
            self.run_within(Budget::ALL, material)?;
            if self.progress.is_settled() {
                return Ok(());
            }
            self.progress.wait()?;
        }
    }
}
