//! Steps of the recorder when time advances or a trigger comes.

use std::sync::Arc;

use super::Recorder;
use super::backfill::{Backfill, Budget};
use super::open_clip::{CloseReason, OpenClip};
use crate::RecordError;
use crate::window::{Group, Window, WindowStep};

/// A clip of windows before the open one. All of it is in the past.
pub(super) struct LateClip {
    open_clip: OpenClip,
    group: Group,
    limit: i64,
}

impl Recorder {
    /// Advances time. Pending steps come before old entries are dropped, as they may need them.
    pub(super) fn pass(&mut self, now: i64) -> Result<(), RecordError> {
        if self.now.is_none() {
            self.state.began_at = now;
        }
        self.now = self.now.max(Some(now));
        self.windows.pass(now);
        self.run()?;
        if self.is_settled() { self.state.trim(self.windows.horizon()) } else { Ok(()) }
    }

    /// Does all pending work; live, long work is left to [`Recorder::work`].
    pub(super) fn run(&mut self) -> Result<(), RecordError> {
        self.run_within(if self.state.context.is_live { Budget::NONE } else { Budget::ALL })
    }

    /// Returns whether a sample of this stamp may be written to the open clip when it comes. During
    /// a backfill, or while the clip is full, it waits in the preroll, so that the file is in order
    /// of arrival.
    pub(super) fn is_prompt(&self, at_ns: i64) -> bool {
        !self.state.context.is_live
            || self.behind.is_none()
                && (self.backfill.is_none() || self.late_clip.is_some())
                && at_ns <= self.windows.limit()
                && self.state.context.writer.has_room()
    }

    /// Returns whether there is nothing left to decide.
    pub(super) fn is_settled(&self) -> bool {
        self.backfill.is_none() && self.behind.is_none() && self.state.context.writer.has_room()
    }

    /// Does the pending work, with backfills as far as `budget` allows.
    pub(super) fn run_within(&mut self, mut budget: Budget) -> Result<(), RecordError> {
        while self.continue_backfill(&mut budget)? && self.state.context.writer.has_room() {
            let held = self.held.clone();
            if held.is_some() {
                self.counts.recording.disk_suppressed += self.windows.forget_waiting();
            }
            let Some(step) = self.windows.step() else {
                // The part that a full clip left for the next one is in it by now.
                if let Some(why) = held
                    && let Some(group) = self.windows.close()
                {
                    let end = self.now.unwrap_or(group.from);
                    self.complete(&group, CloseReason::Early(end, why))?;
                }
                break;
            };
            match step {
                WindowStep::Begin(windows) => self.begin(windows)?,
                WindowStep::Join { windows, fresh_from: Some(from) } => {
                    self.settle(windows, from)?
                }
                // It covers nothing new so far, and its trigger is collected by the caller that
                // added it.
                WindowStep::Join { .. } => {}
                WindowStep::Roll { boundary, before } => self.roll(boundary, &before)?,
                WindowStep::Finish(group) => self.complete(&group, CloseReason::Complete)?,
                WindowStep::Late(windows, group) => self.begin_late_clip(windows, *group)?,
            }
        }
        Ok(())
    }

    /// Continues the backfill; `true` once there is none.
    fn continue_backfill(&mut self, budget: &mut Budget) -> Result<bool, RecordError> {
        loop {
            let Some(mut backfill) = self.backfill.take() else {
                match self.behind.take().filter(|_| self.open_clip.is_some()) {
                    Some(last) => self.backfill = Some(Backfill::from(last, self.windows.limit())),
                    None => return Ok(true),
                }
                continue;
            };
            let is_done = match (&mut self.late_clip, &mut self.open_clip, self.windows.open()) {
                (Some(late_clip), ..) => self.state.backfill(
                    &mut backfill,
                    &mut late_clip.open_clip,
                    &late_clip.group,
                    budget,
                )?,
                (None, Some(open_clip), Some(group)) => {
                    self.state.backfill(&mut backfill, open_clip, group, budget)?
                }
                _ => true,
            };
            if !is_done {
                self.backfill = Some(backfill);
                return Ok(false);
            }
            if let Some(late_clip) = self.late_clip.take() {
                self.end_late_clip(late_clip)?;
            }
        }
    }

    fn begin(&mut self, windows: Vec<Window>) -> Result<(), RecordError> {
        if let Some(group) = self.windows.open() {
            self.groups += 1;
            let opening = self.state.opening(group);
            self.open_clip =
                Some(OpenClip::new(self.groups, opening, group, &mut self.state.context));
        }
        self.settle(windows, i64::MIN)
    }

    fn settle(&mut self, windows: Vec<Window>, fresh_from: i64) -> Result<(), RecordError> {
        if let (Some(open_clip), Some(group)) = (&mut self.open_clip, self.windows.open()) {
            let backfill =
                self.state.settle(open_clip, group, windows, self.windows.limit(), fresh_from)?;
            self.backfill = Some(backfill);
        }
        Ok(())
    }

    /// Continues in a next clip.
    fn roll(&mut self, boundary: i64, before: &Group) -> Result<(), RecordError> {
        let (Some(open_clip), Some(group)) = (&mut self.open_clip, self.windows.open()) else {
            return Ok(());
        };
        if !open_clip.is_empty() {
            let next = open_clip.next(group, &mut self.state.context);
            let full = std::mem::replace(open_clip, next);
            self.finished.add(self.state.finish(full, before, CloseReason::Full(boundary))?);
        }
        // A gap longer than a clip becomes no clips.
        if self.now.is_none_or(|now| now > self.windows.limit()) {
            let until = self.state.earliest(open_clip, group).or(self.now).unwrap_or(boundary);
            if until > self.windows.limit() {
                self.windows.slide(until);
            }
        }
        self.settle(Vec::new(), i64::MIN)
    }

    pub(super) fn complete(
        &mut self,
        group: &Group,
        close: CloseReason,
    ) -> Result<(), RecordError> {
        if let Some(open_clip) = self.open_clip.take() {
            // The previous clip announced a continuation; if nothing followed, there is no empty
            // clip.
            if open_clip.continues && open_clip.is_empty() && open_clip.triggers == 0 {
                return self.state.context.writer.forget(open_clip.clip);
            }
            self.finished.add(self.state.finish(open_clip, group, close)?);
        }
        Ok(())
    }

    fn begin_late_clip(&mut self, windows: Vec<Window>, group: Group) -> Result<(), RecordError> {
        self.groups += 1;
        let opening = self.state.opening(&group);
        let mut open_clip = OpenClip::new(self.groups, opening, &group, &mut self.state.context);
        let limit = group.from.saturating_add(self.max_length_ns);
        self.backfill =
            Some(self.state.settle(&mut open_clip, &group, windows, limit, i64::MIN)?);
        self.late_clip = Some(LateClip { open_clip, group, limit });
        Ok(())
    }

    /// A late clip is backfilled: completes it, or continues in a next one.
    fn end_late_clip(&mut self, late_clip: LateClip) -> Result<(), RecordError> {
        let LateClip { mut open_clip, mut group, limit: boundary } = late_clip;
        if group.to <= boundary {
            self.finished.add(self.state.finish(open_clip, &group, CloseReason::Complete)?);
            return Ok(());
        }
        let before = group.clone();
        group.roll(boundary);
        if !open_clip.is_empty() {
            let next = open_clip.next(&group, &mut self.state.context);
            let full = std::mem::replace(&mut open_clip, next);
            self.finished.add(self.state.finish(full, &before, CloseReason::Full(boundary))?);
        }
        let limit = group.from.saturating_add(self.max_length_ns);
        self.backfill =
            Some(self.state.settle(&mut open_clip, &group, Vec::new(), limit, i64::MIN)?);
        self.late_clip = Some(LateClip { open_clip, group, limit });
        Ok(())
    }

    /// Ends the recording: completes open clips. A clip whose window had not ended notes that.
    /// Live, this waits for the disk.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn finish(&mut self, end_ns: i64) -> Result<(), RecordError> {
        self.state.context.writer.end_recovery();
        self.windows.set_grace(0);
        self.pass(end_ns.max(0))?;
        let end = self.now.unwrap_or(end_ns);
        let is_live = self.state.context.is_live;
        self.settle_all()?;
        while let Some(group) = self.windows.close() {
            let why = || Arc::from("the recording was stopped before the window ended");
            self.complete(
                &group,
                if is_live { CloseReason::Early(end, why()) } else { CloseReason::EndOfDrive(end) },
            )?;
            self.run()?;
            self.settle_all()?;
        }
        self.drain()
    }
}
