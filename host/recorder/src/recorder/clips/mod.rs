//! Clips: from windows to the open clip, and from it to finished ones.
//!
//! One clip is open at a time. Samples are written to it when they come, or later by a backfill
//! from the preroll; a late trigger makes a late clip beside it.

mod backfill;
mod finished;
mod open_clip;
mod waiting;

use std::sync::Arc;

use gleaner_lambda::{Clip, Moment, TriggerKind};
use gleaner_transport::SampleMeta;

use self::backfill::Backfill;
pub use self::backfill::Budget;
pub use self::finished::Finished;
use self::open_clip::CloseReason;
pub use self::open_clip::OpenClip;
use self::waiting::WaitingTriggers;
use super::history::History;
use super::limits::RecorderLimits;
use super::sources::Sources;
use super::writer::ClipDisk;
use crate::RecordError;
use crate::preroll::Walked;
use crate::window::{Group, TriggerOutcome, Window, WindowRules, WindowStep, Windows};

/// A clip of windows before the open one. All of it is in the past.
struct LateClip {
    clip: OpenClip,
    group: Group,
    limit: i64,
}

/// Windows, the clips that are being made of them, and finished ones.
pub struct Clips {
    windows: Windows,
    waiting: WaitingTriggers,
    disk: ClipDisk,
    limits: RecorderLimits,
    /// True if live: long work is left to [`work`](Self::work), and losses upstream count.
    is_live: bool,
    open: Option<OpenClip>,
    late: Option<LateClip>,
    /// The backfill of `late`, or else of `open`. Nothing is decided while it runs.
    backfill: Option<Backfill>,
    /// The last entry before the messages that could not be written to `open` when they came.
    behind: Option<Option<Walked>>,
    /// The reason why recording is suspended.
    held: Option<Arc<str>>,
    /// Number of groups of windows so far.
    groups: u64,
    max_length_ns: i64,
    finished: Finished,
    /// Triggers while recording is suspended.
    disk_suppressed: u64,
}

impl Clips {
    pub fn new(disk: ClipDisk, max_length_ns: i64, is_live: bool) -> Clips {
        Clips {
            windows: Windows::new(max_length_ns),
            waiting: WaitingTriggers::default(),
            disk,
            limits: RecorderLimits::default(),
            is_live,
            open: None,
            late: None,
            backfill: None,
            behind: None,
            held: None,
            groups: 0,
            max_length_ns,
            finished: Finished::default(),
            disk_suppressed: 0,
        }
    }

    /// Adds a lambda; returns its number.
    pub fn add_lambda(&mut self, rules: WindowRules) -> usize {
        self.windows.add(rules)
    }

    pub fn finished(&self) -> &Finished {
        &self.finished
    }

    pub fn finished_mut(&mut self) -> &mut Finished {
        &mut self.finished
    }

    pub fn is_live(&self) -> bool {
        self.is_live
    }

    /// Returns whether a clip is open.
    pub fn is_open(&self) -> bool {
        self.open.is_some()
    }

    pub fn is_held(&self) -> bool {
        self.held.is_some()
    }

    /// Triggers while recording was suspended.
    pub fn disk_suppressed(&self) -> u64 {
        self.disk_suppressed
    }

    pub fn count_suppressed(&mut self, triggers: u64) {
        self.disk_suppressed += triggers;
    }

    /// Bytes on their way to the disk.
    pub fn in_flight(&self) -> u64 {
        self.disk.in_flight() as u64
    }

    #[cfg(test)]
    pub fn set_limits(&mut self, limits: RecorderLimits) {
        self.limits = limits;
    }

    #[cfg(test)]
    pub fn open_clip(&mut self) -> Option<&mut OpenClip> {
        self.open.as_mut()
    }

    /// Suspends recording, for the reason `why`; `None` resumes. Clips end `grace_ns` after their
    /// last window.
    pub fn hold(&mut self, why: Option<&str>, grace_ns: i64) {
        self.held = why.map(Arc::from);
        self.windows.set_grace(grace_ns);
    }

    pub fn set_grace(&mut self, grace_ns: i64) {
        self.windows.set_grace(grace_ns);
    }

    /// Raises the length of the longest clip.
    pub fn grow_length(&mut self, most_ns: i64) {
        self.max_length_ns = self.max_length_ns.max(most_ns);
        self.windows.grow_length(self.max_length_ns);
    }

    /// Forgets places in the preroll, as it has moved.
    pub fn preroll_moved(&mut self) {
        if let Some(backfill) = &mut self.backfill {
            backfill.restart();
        }
        if let Some(behind) = &mut self.behind {
            *behind = None;
        }
        if let Some(clip) = &mut self.open {
            clip.unsettle();
        }
    }

    /// Advances time to `now`, which history knows already. Pending steps come before old entries
    /// are dropped, as they may need them.
    pub fn pass(
        &mut self,
        now: i64,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        self.windows.pass(now);
        self.run(history, sources)?;
        if self.is_settled() { history.trim(self.windows.horizon()) } else { Ok(()) }
    }

    /// Writes a sample to the open clip, if it belongs there. Returns the group whose clip then has
    /// it, or 0.
    pub fn write(
        &mut self,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
        history: &History,
        sources: &Sources,
    ) -> Result<u64, RecordError> {
        let is_prompt = self.is_prompt(meta.at_ns);
        let (Some(clip), Some(group)) = (&mut self.open, self.windows.open()) else {
            return Ok(0);
        };
        if !sources.covers(group, topic, meta.at_ns) {
            return Ok(0);
        }
        if cdr.len() > self.limits.message_bytes {
            clip.tally(topic).refuse();
        } else if is_prompt || !history.preroll().fits(cdr.len()) && self.disk.has_room() {
            clip.write(topic, meta, cdr, group, sources)?;
        } else {
            // It is counted as too big if it cannot be kept; else a backfill writes it later.
            if self.backfill.is_none() || self.late.is_some() {
                self.behind.get_or_insert_with(|| history.preroll().newest());
            }
            return Ok(0);
        }
        Ok(clip.group())
    }

    /// Keeps a wake for the journal of the open clip, if it belongs there. Returns the group whose
    /// clip then has it, or 0.
    pub fn wake(&mut self, lambda: usize, number: u64, at_ns: i64, encoded: &[u8]) -> u64 {
        let (Some(clip), Some(group)) = (&mut self.open, self.windows.open()) else { return 0 };
        if !(group.begin..=group.to.min(self.windows.limit())).contains(&at_ns) {
            return 0;
        }
        clip.journals().push(lambda, number, encoded);
        clip.group()
    }

    /// Applies a trigger; [`act`](Self::act) has to follow.
    pub fn trigger(
        &mut self,
        lambda: usize,
        kind: TriggerKind,
        label: &str,
        at_ns: i64,
    ) -> TriggerOutcome {
        self.windows.trigger(lambda, kind, label, at_ns)
    }

    /// As [`trigger`](Self::trigger), for a command.
    pub fn command(
        &mut self,
        lambda: usize,
        kind: TriggerKind,
        label: &str,
        at_ns: i64,
    ) -> TriggerOutcome {
        self.windows.command(lambda, kind, label, at_ns)
    }

    /// Queues a moment for the clip that it belongs to.
    pub fn await_clip(&mut self, lambda: usize, moment: Moment) {
        self.waiting.push(lambda, moment, &self.windows, self.limits.waiting);
    }

    /// Applies the effects of triggers.
    pub fn act(&mut self, history: &mut History, sources: &Sources) -> Result<(), RecordError> {
        self.run(history, sources)?;
        if let (Some(clip), Some(group)) = (&mut self.open, self.windows.open()) {
            gather(&mut self.waiting, clip, group, self.windows.limit());
        }
        Ok(())
    }

    /// Ends the windows that a lambda has started.
    pub fn end_lambda(
        &mut self,
        lambda: usize,
        at_ns: i64,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        if self.windows.end(lambda, at_ns)
            && let Some(clip) = &mut self.open
        {
            clip.lambda_ended(lambda);
        }
        self.run(history, sources)
    }

    /// Collects outcomes, and sends what writers have collected if the thread has no other work.
    pub fn poll(&mut self) -> Result<(), RecordError> {
        let mut outcomes = Vec::new();
        self.disk.poll(&mut outcomes)?;
        self.finished.note(outcomes);
        if self.disk.is_waiting() { self.flush() } else { Ok(()) }
    }

    /// Returns whether there is nothing left to decide.
    pub fn is_settled(&self) -> bool {
        self.backfill.is_none() && self.behind.is_none() && self.disk.has_room()
    }

    /// Returns whether the disk can take more.
    pub fn has_room(&self) -> bool {
        self.disk.has_room()
    }

    /// Does all pending work; live, long work is left for later.
    pub fn run(&mut self, history: &mut History, sources: &Sources) -> Result<(), RecordError> {
        let budget = if self.is_live { Budget::NONE } else { Budget::ALL };
        self.run_within(budget, history, sources)
    }

    /// Does the pending work, with backfills as far as `budget` allows.
    pub fn run_within(
        &mut self,
        mut budget: Budget,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        while self.continue_backfill(&mut budget, history, sources)? && self.disk.has_room() {
            let held = self.held.clone();
            if held.is_some() {
                self.disk_suppressed += self.windows.forget_waiting();
            }
            let Some(step) = self.windows.step() else {
                // The part that a full clip left for the next one is in it by now.
                if let Some(why) = held
                    && let Some(group) = self.windows.close()
                {
                    let end = history.now().unwrap_or(group.from);
                    self.complete(&group, CloseReason::Early(end, why), history, sources)?;
                }
                break;
            };
            match step {
                WindowStep::Begin(windows) => self.begin(windows, history, sources)?,
                WindowStep::Join { windows, fresh_from: Some(from) } => {
                    self.settle(windows, from, history, sources)?
                }
                // It covers nothing new so far, and its trigger is collected by the caller that
                // added it.
                WindowStep::Join { .. } => {}
                WindowStep::Roll { boundary, before } => {
                    self.roll(boundary, &before, history, sources)?
                }
                WindowStep::Finish(group) => {
                    self.complete(&group, CloseReason::Complete, history, sources)?
                }
                WindowStep::Late(windows, group) => {
                    self.begin_late(windows, *group, history, sources)?
                }
            }
        }
        Ok(())
    }

    /// Ends the recording: completes open clips. Live, this waits for the disk.
    pub fn finish(
        &mut self,
        end: i64,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        self.settle_all(history, sources)?;
        while let Some(group) = self.windows.close() {
            let why = || Arc::from("the recording was stopped before the window ended");
            let close = match self.is_live {
                true => CloseReason::Early(end, why()),
                false => CloseReason::EndOfDrive(end),
            };
            self.complete(&group, close, history, sources)?;
            self.run(history, sources)?;
            self.settle_all(history, sources)?;
        }
        while !self.disk.is_idle() {
            self.wait()?;
        }
        Ok(())
    }

    /// Gives the recovery of an earlier process's clips some more seconds.
    pub fn end_recovery(&self) {
        self.disk.end_recovery();
    }

    /// Does all pending work, however long it takes.
    fn settle_all(&mut self, history: &mut History, sources: &Sources) -> Result<(), RecordError> {
        loop {
            self.run_within(Budget::ALL, history, sources)?;
            if self.is_settled() {
                return Ok(());
            }
            self.wait()?;
        }
    }

    /// Waits until a job of the disk is done.
    fn wait(&mut self) -> Result<(), RecordError> {
        self.flush()?;
        let mut outcomes = Vec::new();
        self.disk.wait(&mut outcomes)?;
        self.finished.note(outcomes);
        Ok(())
    }

    fn flush(&mut self) -> Result<(), RecordError> {
        let late = self.late.as_mut().map(|late| &mut late.clip);
        self.open.iter_mut().chain(late).try_for_each(OpenClip::flush)
    }

    /// Returns whether a sample of this stamp may be written to the open clip when it comes. During
    /// a backfill, or while the clip is full, it waits in the preroll, so that the file is in order
    /// of arrival.
    fn is_prompt(&self, at_ns: i64) -> bool {
        !self.is_live
            || self.behind.is_none()
                && (self.backfill.is_none() || self.late.is_some())
                && at_ns <= self.windows.limit()
                && self.disk.has_room()
    }

    /// Continues the backfill; `true` once there is none.
    fn continue_backfill(
        &mut self,
        budget: &mut Budget,
        history: &mut History,
        sources: &Sources,
    ) -> Result<bool, RecordError> {
        loop {
            let Some(mut backfill) = self.backfill.take() else {
                match self.behind.take().filter(|_| self.open.is_some()) {
                    Some(last) => self.backfill = Some(Backfill::after(last, self.windows.limit())),
                    None => return Ok(true),
                }
                continue;
            };
            let filled = match (&mut self.late, &mut self.open, self.windows.open()) {
                (Some(late), ..) => Some((&mut late.clip, &late.group)),
                (None, Some(clip), Some(group)) => Some((clip, group)),
                _ => None,
            };
            if let Some((clip, group)) = filled {
                let preroll = history.preroll_mut();
                if !backfill.step(clip, group, sources, preroll, &self.disk, budget)? {
                    self.backfill = Some(backfill);
                    return Ok(false);
                }
                // Entries that were evicted meanwhile.
                let limit = backfill.limit();
                for window in backfill.windows() {
                    history.reach_back(clip, window, sources);
                }
                history.count_losses(clip, group, sources, limit);
                gather(&mut self.waiting, clip, group, limit);
            }
            if let Some(late) = self.late.take() {
                self.end_late(late, history, sources)?;
            }
        }
    }

    /// An empty clip of `group`.
    fn new_clip(&mut self, group: &Group, sources: &Sources) -> OpenClip {
        self.groups += 1;
        let (lambda, at_ns) = group.first;
        let opening = self.waiting.find(lambda, at_ns).cloned().unwrap_or_else(|| Moment {
            lambda: sources.name(lambda).to_owned(),
            kind: TriggerKind::Event,
            label: String::new(),
            score: None,
            attributes: None,
            at_ns,
            source: None,
        });
        OpenClip::new(self.groups, opening, group, self.disk.new_clip(), self.limits)
    }

    fn begin(
        &mut self,
        windows: Vec<Window>,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        if let Some(group) = self.windows.open().cloned() {
            self.open = Some(self.new_clip(&group, sources));
        }
        self.settle(windows, i64::MIN, history, sources)
    }

    fn settle(
        &mut self,
        windows: Vec<Window>,
        fresh_from: i64,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        if let (Some(clip), Some(group)) = (&mut self.open, self.windows.open()) {
            let limit = self.windows.limit();
            let backfill = backfill(clip, group, windows, limit, fresh_from, history, sources)?;
            self.backfill = Some(backfill);
        }
        Ok(())
    }

    /// Continues in a next clip.
    fn roll(
        &mut self,
        boundary: i64,
        before: &Group,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        let (Some(clip), Some(group)) = (&mut self.open, self.windows.open()) else {
            return Ok(());
        };
        if !clip.is_empty() {
            let next = clip.next(group, self.disk.new_clip());
            let full = std::mem::replace(clip, next);
            self.end(full, before, CloseReason::Full(boundary), history, sources)?;
        }
        let (Some(clip), Some(group)) = (&self.open, self.windows.open()) else { return Ok(()) };
        // A gap longer than a clip becomes no clips.
        if history.now().is_none_or(|now| now > self.windows.limit()) {
            let earliest = earliest(clip, group, history, sources);
            let until = earliest.or(history.now()).unwrap_or(boundary);
            if until > self.windows.limit() {
                self.windows.slide(until);
            }
        }
        self.settle(Vec::new(), i64::MIN, history, sources)
    }

    fn complete(
        &mut self,
        group: &Group,
        close: CloseReason,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        match self.open.take() {
            Some(clip) if !clip.is_pointless() => self.end(clip, group, close, history, sources),
            _ => Ok(()),
        }
    }

    /// Completes a clip.
    fn end(
        &mut self,
        mut clip: OpenClip,
        group: &Group,
        close: CloseReason,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        let limit = if let CloseReason::Full(boundary) = close { boundary } else { i64::MAX };
        let uncertain = self.waiting.uncertain(group, limit);
        if self.is_live {
            history.count_lost(&mut clip, group, sources, limit);
        }
        let clip: Option<Clip> = clip.finish(group, &close, &uncertain, sources)?;
        self.finished.add(clip);
        Ok(())
    }

    fn begin_late(
        &mut self,
        windows: Vec<Window>,
        group: Group,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        let clip = self.new_clip(&group, sources);
        self.fill_late(clip, windows, group, history, sources)
    }

    fn fill_late(
        &mut self,
        mut clip: OpenClip,
        windows: Vec<Window>,
        group: Group,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        let limit = group.from.saturating_add(self.max_length_ns);
        let backfill = backfill(&mut clip, &group, windows, limit, i64::MIN, history, sources)?;
        self.backfill = Some(backfill);
        self.late = Some(LateClip { clip, group, limit });
        Ok(())
    }

    /// A late clip is backfilled: completes it, or continues in a next one.
    fn end_late(
        &mut self,
        late: LateClip,
        history: &mut History,
        sources: &Sources,
    ) -> Result<(), RecordError> {
        let LateClip { mut clip, mut group, limit: boundary } = late;
        if group.to <= boundary {
            return self.end(clip, &group, CloseReason::Complete, history, sources);
        }
        let before = group.clone();
        group.roll(boundary);
        if !clip.is_empty() {
            let next = clip.next(&group, self.disk.new_clip());
            let full = std::mem::replace(&mut clip, next);
            self.end(full, &before, CloseReason::Full(boundary), history, sources)?;
        }
        self.fill_late(clip, Vec::new(), group, history, sources)
    }
}

/// Starts a backfill, and counts what is already lost.
fn backfill(
    clip: &mut OpenClip,
    group: &Group,
    windows: Vec<Window>,
    limit: i64,
    fresh_from: i64,
    history: &mut History,
    sources: &Sources,
) -> Result<Backfill, RecordError> {
    windows.iter().for_each(|window| history.reach_back(clip, window, sources));
    history.count_losses(clip, group, sources, limit);
    Backfill::new(clip, group, windows, limit, fresh_from, sources)
}

/// The stamp of the earliest sample that is covered, but in no clip of the group.
fn earliest(clip: &OpenClip, group: &Group, history: &History, sources: &Sources) -> Option<i64> {
    let preroll = history.preroll();
    let mut earliest = None;
    let mut next = preroll.next(None);
    while let Some(place) = next.map(Walked::place) {
        let held = preroll.held(place);
        if held.source.as_topic().is_some() && clip.lacks(&held, group, i64::MAX, sources) {
            earliest = Some(earliest.map_or(held.at_ns, |at: i64| at.min(held.at_ns)));
        }
        next = preroll.next(next);
    }
    earliest
}

/// Collects the triggers within a clip.
fn gather(waiting: &mut WaitingTriggers, clip: &mut OpenClip, group: &Group, limit: i64) {
    let counted = waiting.take(group, limit, |moment| clip.moment(moment));
    clip.count_triggers(counted);
}
