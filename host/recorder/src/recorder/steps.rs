//! What a recorder does when time passes or a trigger comes.

use std::sync::Arc;

use super::Recorder;
use super::draft::{Close, Draft};
use super::walk::{Budget, Walk};
use crate::RecordError;
use crate::window::{Group, Step, Window};

/// A clip of windows that lie before the one that is open. All of it is in the past.
pub(super) struct Stray {
    draft: Draft,
    group: Group,
    limit: i64,
}

impl Recorder {
    /// Lets time pass. What is due is done before anything is given up for its age: it may need it.
    pub(super) fn pass(&mut self, now: i64) -> Result<(), RecordError> {
        if self.now.is_none() {
            self.stock.began_at = now;
        }
        self.now = self.now.max(Some(now));
        self.windows.pass(now);
        self.run()?;
        if self.is_settled() { self.stock.trim(self.windows.horizon()) } else { Ok(()) }
    }

    /// Does all that is to be done; live, what takes long is left to [`Recorder::work`].
    pub(super) fn run(&mut self) -> Result<(), RecordError> {
        self.run_within(if self.stock.desk.is_live { Budget::NONE } else { Budget::ALL })
    }

    /// Whether a sample of this stamp may be written to the open clip when it comes. While the clip
    /// is being brought up to what is held, or is full, it waits its turn in the preroll, so that a
    /// file is in the order in which things came.
    pub(super) fn is_prompt(&self, at_ns: i64) -> bool {
        !self.stock.desk.is_live
            || self.behind.is_none()
                && (self.walk.is_none() || self.stray.is_some())
                && at_ns <= self.windows.limit()
                && self.stock.desk.pen.has_room()
    }

    /// Whether all is decided that can be.
    pub(super) fn is_settled(&self) -> bool {
        self.walk.is_none() && self.behind.is_none() && self.stock.desk.pen.has_room()
    }

    /// Does what is to be done, with walks as far as `budget` reaches.
    pub(super) fn run_within(&mut self, mut budget: Budget) -> Result<(), RecordError> {
        while self.walk_on(&mut budget)? && self.stock.desk.pen.has_room() {
            let held = self.held.clone();
            if held.is_some() {
                self.counts.recording.disk_suppressed += self.windows.forget_waiting();
            }
            let Some(step) = self.windows.step() else {
                // What a full clip has kept for its next one is in that by now.
                if let Some(why) = held
                    && let Some(group) = self.windows.close()
                {
                    let end = self.now.unwrap_or(group.from);
                    self.complete(&group, Close::Early(end, why))?;
                }
                break;
            };
            match step {
                Step::Begin(windows) => self.begin(windows)?,
                Step::Join { windows, fresh_from: Some(from) } => self.settle(windows, from)?,
                // It covers nothing new so far, and its trigger is gathered by whoever brought it.
                Step::Join { .. } => {}
                Step::Roll { boundary, before } => self.roll(boundary, &before)?,
                Step::Finish(group) => self.complete(&group, Close::Complete)?,
                Step::Stray(windows, group) => self.begin_stray(windows, *group)?,
            }
        }
        Ok(())
    }

    /// Goes on with what is under way; `true` once nothing is.
    fn walk_on(&mut self, budget: &mut Budget) -> Result<bool, RecordError> {
        loop {
            let Some(mut walk) = self.walk.take() else {
                match self.behind.take().filter(|_| self.draft.is_some()) {
                    Some(last) => self.walk = Some(Walk::from(last, self.windows.limit())),
                    None => return Ok(true),
                }
                continue;
            };
            let is_done = match (&mut self.stray, &mut self.draft, self.windows.open()) {
                (Some(stray), ..) => {
                    self.stock.walk(&mut walk, &mut stray.draft, &stray.group, budget)?
                }
                (None, Some(draft), Some(group)) => {
                    self.stock.walk(&mut walk, draft, group, budget)?
                }
                _ => true,
            };
            if !is_done {
                self.walk = Some(walk);
                return Ok(false);
            }
            if let Some(stray) = self.stray.take() {
                self.end_stray(stray)?;
            }
        }
    }

    fn begin(&mut self, windows: Vec<Window>) -> Result<(), RecordError> {
        if let Some(group) = self.windows.open() {
            self.groups += 1;
            let opening = self.stock.opening(group);
            self.draft = Some(Draft::new(self.groups, opening, group, &mut self.stock.desk));
        }
        self.settle(windows, i64::MIN)
    }

    fn settle(&mut self, windows: Vec<Window>, fresh_from: i64) -> Result<(), RecordError> {
        if let (Some(draft), Some(group)) = (&mut self.draft, self.windows.open()) {
            let walk =
                self.stock.settle(draft, group, windows, self.windows.limit(), fresh_from)?;
            self.walk = Some(walk);
        }
        Ok(())
    }

    /// Goes on in a next clip.
    fn roll(&mut self, boundary: i64, before: &Group) -> Result<(), RecordError> {
        let (Some(draft), Some(group)) = (&mut self.draft, self.windows.open()) else {
            return Ok(());
        };
        if !draft.is_empty() {
            let next = draft.next(group, &mut self.stock.desk);
            let full = std::mem::replace(draft, next);
            self.finished.add(self.stock.finish(full, before, Close::Full(boundary))?);
        }
        // Where nothing came for longer than a clip may be, no clips are made of it.
        if self.now.is_none_or(|now| now > self.windows.limit()) {
            let until = self.stock.earliest(draft, group).or(self.now).unwrap_or(boundary);
            if until > self.windows.limit() {
                self.windows.slide(until);
            }
        }
        self.settle(Vec::new(), i64::MIN)
    }

    pub(super) fn complete(&mut self, group: &Group, close: Close) -> Result<(), RecordError> {
        if let Some(draft) = self.draft.take() {
            // The clip before promised that more would come; where nothing did, there is no clip of
            // nothing.
            if draft.continues && draft.is_empty() && draft.triggers == 0 {
                return self.stock.desk.pen.forget(draft.clip);
            }
            self.finished.add(self.stock.finish(draft, group, close)?);
        }
        Ok(())
    }

    fn begin_stray(&mut self, windows: Vec<Window>, group: Group) -> Result<(), RecordError> {
        self.groups += 1;
        let opening = self.stock.opening(&group);
        let mut draft = Draft::new(self.groups, opening, &group, &mut self.stock.desk);
        let limit = group.from.saturating_add(self.max_length_ns);
        self.walk = Some(self.stock.settle(&mut draft, &group, windows, limit, i64::MIN)?);
        self.stray = Some(Stray { draft, group, limit });
        Ok(())
    }

    /// A stray clip has what is held of it: completes it, or goes on in a next one.
    fn end_stray(&mut self, stray: Stray) -> Result<(), RecordError> {
        let Stray { mut draft, mut group, limit: boundary } = stray;
        if group.to <= boundary {
            self.finished.add(self.stock.finish(draft, &group, Close::Complete)?);
            return Ok(());
        }
        let before = group.clone();
        group.roll(boundary);
        if !draft.is_empty() {
            let next = draft.next(&group, &mut self.stock.desk);
            let full = std::mem::replace(&mut draft, next);
            self.finished.add(self.stock.finish(full, &before, Close::Full(boundary))?);
        }
        let limit = group.from.saturating_add(self.max_length_ns);
        self.walk = Some(self.stock.settle(&mut draft, &group, Vec::new(), limit, i64::MIN)?);
        self.stray = Some(Stray { draft, group, limit });
        Ok(())
    }

    /// The drive ends: completes what is open. A clip whose window had not ended says so. Live,
    /// this waits for the disk.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn finish(&mut self, end_ns: i64) -> Result<(), RecordError> {
        self.stock.desk.pen.end_recovery();
        self.windows.set_grace(0);
        self.pass(end_ns.max(0))?;
        let end = self.now.unwrap_or(end_ns);
        let is_live = self.stock.desk.is_live;
        self.settle_all()?;
        while let Some(group) = self.windows.close() {
            let why = || Arc::from("the recording was stopped before the window ended");
            self.complete(
                &group,
                if is_live { Close::Early(end, why()) } else { Close::EndOfDrive(end) },
            )?;
            self.run()?;
            self.settle_all()?;
        }
        self.drain()
    }
}
