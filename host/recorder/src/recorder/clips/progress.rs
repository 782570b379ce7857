//! The clips that are being made, and the disk that they are written to.

use gleaner_lambda::{Clip, Moment, TriggerKind};
use gleaner_transport::SampleMeta;

use super::backfill::{Backfill, Budget};
use super::finished::Finished;
use super::open_clip::{CloseReason, OpenClip};
use super::waiting::WaitingTriggers;
use crate::RecordError;
use crate::preroll::Walked;
use crate::recorder::Material;
use crate::recorder::limits::RecorderLimits;
use crate::recorder::writer::ClipDisk;
use crate::window::{Group, Window, Windows};

/// A clip of windows before the open one. All of it is in the past.
struct LateClip {
    clip: OpenClip,
    group: Group,
    limit: i64,
}

/// The clips that are being made. Windows decide when each begins and ends.
pub struct ClipsInProgress {
    disk: ClipDisk,
    limits: RecorderLimits,
    /// True if live: long work is left for later, and losses upstream count.
    is_live: bool,
    waiting: WaitingTriggers,
    open: Option<OpenClip>,
    late: Option<LateClip>,
    /// The backfill of `late`, or else of `open`. Nothing is decided while it runs.
    backfill: Option<Backfill>,
    /// The last entry before the messages that could not be written to `open` when they came.
    behind: Option<Option<Walked>>,
    groups: u64,
    max_length_ns: i64,
    finished: Finished,
}

impl ClipsInProgress {
    pub fn new(disk: ClipDisk, max_length_ns: i64, is_live: bool) -> ClipsInProgress {
        ClipsInProgress {
            disk,
            limits: RecorderLimits::default(),
            is_live,
            waiting: WaitingTriggers::default(),
            open: None,
            late: None,
            backfill: None,
            behind: None,
            groups: 0,
            max_length_ns,
            finished: Finished::default(),
        }
    }

    pub fn is_live(&self) -> bool {
        self.is_live
    }

    /// The clip of the current windows.
    pub fn open(&mut self) -> Option<&mut OpenClip> {
        self.open.as_mut()
    }

    pub fn is_open(&self) -> bool {
        self.open.is_some()
    }

    pub fn disk(&self) -> &ClipDisk {
        &self.disk
    }

    pub fn finished(&self) -> &Finished {
        &self.finished
    }

    pub fn finished_mut(&mut self) -> &mut Finished {
        &mut self.finished
    }

    /// Raises the length of the longest clip; returns it.
    pub fn grow_length(&mut self, most_ns: i64) -> i64 {
        self.max_length_ns = self.max_length_ns.max(most_ns);
        self.max_length_ns
    }

    #[cfg(test)]
    pub fn set_limits(&mut self, limits: RecorderLimits) {
        self.limits = limits;
    }

    /// Collects the triggers of the open clip.
    pub fn gather(&mut self, windows: &Windows) {
        if let (Some(clip), Some(group)) = (&mut self.open, windows.open()) {
            gather(&mut self.waiting, clip, group, windows.limit());
        }
    }

    /// Returns whether there is nothing left to decide.
    pub fn is_settled(&self) -> bool {
        self.backfill.is_none() && self.behind.is_none() && self.disk.has_room()
    }

    /// Returns whether the disk can take more.
    pub fn has_room(&self) -> bool {
        self.disk.has_room()
    }

    /// Bytes on their way to the disk.
    pub fn in_flight(&self) -> u64 {
        self.disk.in_flight() as u64
    }

    pub fn await_clip(&mut self, lambda: usize, moment: Moment, windows: &Windows) {
        self.waiting.push(lambda, moment, windows, self.limits.waiting);
    }

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

    /// Writes a sample to the open clip, if it belongs there. Returns the group whose clip then has
    /// it, or 0.
    pub fn write(
        &mut self,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
        windows: &Windows,
        material: &Material,
    ) -> Result<u64, RecordError> {
        let is_prompt = self.is_prompt(meta.at_ns, windows);
        let (Some(clip), Some(group)) = (&mut self.open, windows.open()) else {
            return Ok(0);
        };
        if !material.sources.covers(group, topic, meta.at_ns) {
            return Ok(0);
        }
        if cdr.len() > self.limits.message_bytes {
            clip.tally(topic).refuse();
        } else if is_prompt || !material.history.preroll().fits(cdr.len()) && self.disk.has_room() {
            clip.write(topic, meta, cdr, group, &material.sources)?;
        } else {
            // It is counted as too big if it cannot be kept; else a backfill writes it later.
            if self.backfill.is_none() || self.late.is_some() {
                self.behind.get_or_insert_with(|| material.history.preroll().newest());
            }
            return Ok(0);
        }
        Ok(clip.group())
    }

    /// Keeps a wake for the journal of the open clip, if it belongs there. Returns the group whose
    /// clip then has it, or 0.
    pub fn wake(
        &mut self,
        lambda: usize,
        number: u64,
        at_ns: i64,
        encoded: &[u8],
        windows: &Windows,
    ) -> u64 {
        let (Some(clip), Some(group)) = (&mut self.open, windows.open()) else { return 0 };
        if !(group.begin..=group.to.min(windows.limit())).contains(&at_ns) {
            return 0;
        }
        clip.journals().push(lambda, number, encoded);
        clip.group()
    }

    /// Collects outcomes, and sends what writers have collected if the thread has no other work.
    pub fn poll(&mut self) -> Result<(), RecordError> {
        let mut outcomes = Vec::new();
        self.disk.poll(&mut outcomes)?;
        self.finished.note(outcomes);
        if self.disk.is_waiting() { self.flush() } else { Ok(()) }
    }

    /// Waits until a job of the disk is done.
    pub fn wait(&mut self) -> Result<(), RecordError> {
        self.flush()?;
        let mut outcomes = Vec::new();
        self.disk.wait(&mut outcomes)?;
        self.finished.note(outcomes);
        Ok(())
    }

    /// Continues the backfill; `true` once there is none.
    pub fn continue_backfill(
        &mut self,
        budget: &mut Budget,
        windows: &Windows,
        material: &mut Material,
    ) -> Result<bool, RecordError> {
        loop {
            let Some(mut backfill) = self.backfill.take() else {
                match self.behind.take().filter(|_| self.open.is_some()) {
                    Some(last) => self.backfill = Some(Backfill::after(last, windows.limit())),
                    None => return Ok(true),
                }
                continue;
            };
            let filled = match (&mut self.late, &mut self.open, windows.open()) {
                (Some(late), ..) => Some((&mut late.clip, &late.group)),
                (None, Some(clip), Some(group)) => Some((clip, group)),
                _ => None,
            };
            if let Some((clip, group)) = filled {
                let Material { sources, history } = &mut *material;
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
                self.end_late(late, material)?;
            }
        }
    }

    pub fn begin(
        &mut self,
        joined: Vec<Window>,
        windows: &Windows,
        material: &mut Material,
    ) -> Result<(), RecordError> {
        if let Some(group) = windows.open().cloned() {
            self.open = Some(self.new_clip(&group, material));
        }
        self.settle(joined, i64::MIN, windows, material)
    }

    pub fn settle(
        &mut self,
        joined: Vec<Window>,
        fresh_from: i64,
        windows: &Windows,
        material: &mut Material,
    ) -> Result<(), RecordError> {
        if let (Some(clip), Some(group)) = (&mut self.open, windows.open()) {
            let limit = windows.limit();
            let backfill = backfill(clip, group, joined, limit, fresh_from, material)?;
            self.backfill = Some(backfill);
        }
        Ok(())
    }

    /// Continues in a next clip.
    pub fn roll(
        &mut self,
        boundary: i64,
        before: &Group,
        windows: &mut Windows,
        material: &mut Material,
    ) -> Result<(), RecordError> {
        let (Some(clip), Some(group)) = (&mut self.open, windows.open()) else {
            return Ok(());
        };
        if !clip.has_nothing() {
            let next = clip.next(group, self.disk.new_clip());
            let full = std::mem::replace(clip, next);
            self.end(full, before, CloseReason::Full(boundary), material)?;
        }
        let (Some(clip), Some(group)) = (&self.open, windows.open()) else { return Ok(()) };
        // A gap longer than a clip becomes no clips.
        if material.history.now().is_none_or(|now| now > windows.limit()) {
            let earliest = earliest(clip, group, material);
            let until = earliest.or(material.history.now()).unwrap_or(boundary);
            if until > windows.limit() {
                windows.slide(until);
            }
        }
        self.settle(Vec::new(), i64::MIN, windows, material)
    }

    pub fn complete(
        &mut self,
        group: &Group,
        close: CloseReason,
        material: &mut Material,
    ) -> Result<(), RecordError> {
        match self.open.take() {
            Some(clip) if !clip.is_pointless() => self.end(clip, group, close, material),
            _ => Ok(()),
        }
    }

    pub fn begin_late(
        &mut self,
        windows: Vec<Window>,
        group: Group,
        material: &mut Material,
    ) -> Result<(), RecordError> {
        let clip = self.new_clip(&group, material);
        self.fill_late(clip, windows, group, material)
    }

    fn fill_late(
        &mut self,
        mut clip: OpenClip,
        windows: Vec<Window>,
        group: Group,
        material: &mut Material,
    ) -> Result<(), RecordError> {
        let limit = group.from.saturating_add(self.max_length_ns);
        let backfill = backfill(&mut clip, &group, windows, limit, i64::MIN, material)?;
        self.backfill = Some(backfill);
        self.late = Some(LateClip { clip, group, limit });
        Ok(())
    }

    /// A late clip is backfilled: completes it, or continues in a next one.
    fn end_late(&mut self, late: LateClip, material: &mut Material) -> Result<(), RecordError> {
        let LateClip { mut clip, mut group, limit: boundary } = late;
        if group.to <= boundary {
            return self.end(clip, &group, CloseReason::Complete, material);
        }
        let before = group.clone();
        group.roll(boundary);
        if !clip.has_nothing() {
            let next = clip.next(&group, self.disk.new_clip());
            let full = std::mem::replace(&mut clip, next);
            self.end(full, &before, CloseReason::Full(boundary), material)?;
        }
        self.fill_late(clip, Vec::new(), group, material)
    }

    fn end(
        &mut self,
        mut clip: OpenClip,
        group: &Group,
        close: CloseReason,
        material: &mut Material,
    ) -> Result<(), RecordError> {
        let limit = if let CloseReason::Full(boundary) = close { boundary } else { i64::MAX };
        let uncertain = self.waiting.uncertain(group, limit);
        if self.is_live {
            material.history.count_lost(&mut clip, group, &material.sources, limit);
        }
        let clip: Option<Clip> = clip.finish(group, &close, &uncertain, &material.sources)?;
        self.finished.add(clip);
        Ok(())
    }

    fn new_clip(&mut self, group: &Group, material: &Material) -> OpenClip {
        self.groups += 1;
        let (lambda, at_ns) = group.first;
        let opening = self.waiting.find(lambda, at_ns).cloned().unwrap_or_else(|| Moment {
            lambda: material.sources.name(lambda).to_owned(),
            kind: TriggerKind::Event,
            label: String::new(),
            score: None,
            attributes: None,
            at_ns,
            source: None,
        });
        OpenClip::new(self.groups, opening, group, self.disk.new_clip(), self.limits)
    }

    fn flush(&mut self) -> Result<(), RecordError> {
        let late = self.late.as_mut().map(|late| &mut late.clip);
        self.open.iter_mut().chain(late).try_for_each(OpenClip::flush)
    }

    /// Returns whether a sample of this stamp may be written to the open clip when it comes. During
    /// a backfill, or while the clip is full, it waits in the preroll, so that the file is in order
    /// of arrival.
    fn is_prompt(&self, at_ns: i64, windows: &Windows) -> bool {
        !self.is_live
            || self.behind.is_none()
                && (self.backfill.is_none() || self.late.is_some())
                && at_ns <= windows.limit()
                && self.disk.has_room()
    }
}

/// Starts a backfill, and counts what is already lost.
fn backfill(
    clip: &mut OpenClip,
    group: &Group,
    windows: Vec<Window>,
    limit: i64,
    fresh_from: i64,
    material: &mut Material,
) -> Result<Backfill, RecordError> {
    let Material { sources, history } = material;
    windows.iter().for_each(|window| history.reach_back(clip, window, sources));
    history.count_losses(clip, group, sources, limit);
    history.begin_latched(clip, group, sources)?;
    Backfill::new(clip, group, windows, limit, fresh_from, sources)
}

/// The stamp of the earliest sample that is covered, but in no clip of the group.
fn earliest(clip: &OpenClip, group: &Group, material: &Material) -> Option<i64> {
    let Material { sources, history } = material;
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

fn gather(waiting: &mut WaitingTriggers, clip: &mut OpenClip, group: &Group, limit: i64) {
    let counted = waiting.take(group, limit, |moment| clip.moment(moment));
    clip.count_triggers(counted);
}
