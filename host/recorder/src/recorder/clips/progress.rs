//! The clips that are being made, and the disk that they are written to.

use gleaner_lambda::{Clip, Moment, TriggerKind};
use gleaner_messages::transport::SampleMeta;

use super::backfill::{Backfill, Budget};
use super::finished::Finished;
use super::open_clip::{CloseReason, OpenClip};
use super::waiting::WaitingTriggers;
use crate::RecordError;
use crate::preroll::PrerollCursor;
use crate::recorder::RecorderContext;
use crate::recorder::limits::RecorderLimits;
use crate::recorder::writer::ClipDisk;
use crate::window::{Group, Window, Windows};

/// The clip of the current windows.
struct CurrentClip {
    clip: OpenClip,
    fill: ClipFill,
}

/// The part of the current windows that their clip has.
enum ClipFill {
    /// It has all of it: samples are written when they come.
    UpToDate,
    /// It lacks messages after this entry of the preroll, or after its begin: they could not be
    /// written when they came.
    Behind(Option<PrerollCursor>),
    /// It is being filled from the preroll. Nothing is decided meanwhile.
    Filling(Backfill),
}

/// A clip of windows before the open one. All of it is in the past, and nothing is decided while it
/// is filled.
struct LateClip {
    clip: OpenClip,
    group: Group,
    backfill: Backfill,
}

/// The clips that are being made. Windows decide when each begins and ends.
pub struct ClipsInProgress {
    pub disk: ClipDisk,
    limits: RecorderLimits,
    /// True if live: long work is left for later, and losses upstream count.
    pub is_live: bool,
    waiting: WaitingTriggers,
    open: Option<CurrentClip>,
    late: Option<LateClip>,
    groups: u64,
    max_length_ns: i64,
    pub finished: Finished,
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
            groups: 0,
            max_length_ns,
            finished: Finished::default(),
        }
    }

    /// The clip of the current windows.
    pub fn open(&mut self) -> Option<&mut OpenClip> {
        self.open.as_mut().map(|open| &mut open.clip)
    }

    pub fn is_open(&self) -> bool {
        self.open.is_some()
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
        if let (Some(open), Some(group)) = (&mut self.open, windows.open()) {
            gather(&mut self.waiting, &mut open.clip, group, windows.limit());
        }
    }

    /// Returns whether there is nothing left to decide.
    pub fn is_settled(&self) -> bool {
        let is_filled = |open: &CurrentClip| matches!(open.fill, ClipFill::UpToDate);
        self.late.is_none() && self.open.as_ref().is_none_or(is_filled) && self.disk.has_room()
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
        if let Some(late) = &mut self.late {
            late.backfill.restart();
        }
        let Some(CurrentClip { clip, fill }) = &mut self.open else { return };
        match fill {
            ClipFill::UpToDate => {}
            ClipFill::Behind(last) => *last = None,
            ClipFill::Filling(backfill) => backfill.restart(),
        }
        clip.unsettle();
    }

    /// Writes a sample to the open clip, if it belongs there. Returns the group whose clip then has
    /// it, or 0.
    pub fn write(
        &mut self,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
        windows: &Windows,
        material: &RecorderContext,
    ) -> Result<u64, RecordError> {
        let (Some(CurrentClip { clip, fill }), Some(group)) = (&mut self.open, windows.open())
        else {
            return Ok(0);
        };
        if !material.sources.covers(group, topic, meta.at_ns) {
            return Ok(0);
        }
        // During a backfill, or while the clip is full, a sample waits in the preroll, so that the
        // file is in order of arrival.
        let is_up_to_date = matches!(fill, ClipFill::UpToDate);
        let is_prompt =
            !self.is_live || is_up_to_date && meta.at_ns <= windows.limit() && self.disk.has_room();
        if cdr.len() > self.limits.message_bytes {
            clip.tally(topic).refuse();
        } else if is_prompt || !material.history.preroll.fits(cdr.len()) && self.disk.has_room() {
            clip.write(topic, meta, cdr, group, &material.sources)?;
        } else {
            // It is counted as too big if it cannot be kept; else a backfill writes it later.
            if is_up_to_date {
                *fill = ClipFill::Behind(material.history.preroll.newest());
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
        let (Some(CurrentClip { clip, .. }), Some(group)) = (&mut self.open, windows.open()) else {
            return 0;
        };
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

    /// Continues backfills; `true` once there is none.
    pub fn continue_backfill(
        &mut self,
        budget: &mut Budget,
        windows: &Windows,
        material: &mut RecorderContext,
    ) -> Result<bool, RecordError> {
        loop {
            let (clip, group, backfill) = match (&mut self.late, &mut self.open, windows.open()) {
                (Some(LateClip { clip, group, backfill }), ..) => (clip, &*group, backfill),
                (None, Some(CurrentClip { clip, fill }), Some(group)) => {
                    if let ClipFill::Behind(last) = fill {
                        *fill = ClipFill::Filling(Backfill::after(*last, windows.limit()));
                    }
                    let ClipFill::Filling(backfill) = fill else { return Ok(true) };
                    (clip, group, backfill)
                }
                _ => return Ok(true),
            };
            let RecorderContext { sources, history } = &mut *material;
            let preroll = &mut history.preroll;
            if !backfill.step(clip, group, sources, preroll, &self.disk, budget)? {
                return Ok(false);
            }
            // Entries that were evicted meanwhile.
            let limit = backfill.limit();
            for window in backfill.windows() {
                history.reach_back(clip, window, sources);
            }
            history.count_losses(clip, group, sources, limit);
            gather(&mut self.waiting, clip, group, limit);
            if let Some(late) = self.late.take() {
                self.end_late(late, material)?;
            } else if let Some(open) = &mut self.open {
                open.fill = ClipFill::UpToDate;
            }
        }
    }

    pub fn begin(
        &mut self,
        joined: Vec<Window>,
        windows: &Windows,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        if let Some(group) = windows.open().cloned() {
            let clip = self.new_clip(&group, material);
            self.open = Some(CurrentClip { clip, fill: ClipFill::UpToDate });
        }
        self.settle(joined, i64::MIN, windows, material)
    }

    pub fn settle(
        &mut self,
        joined: Vec<Window>,
        fresh_from: i64,
        windows: &Windows,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        if let (Some(CurrentClip { clip, fill }), Some(group)) = (&mut self.open, windows.open()) {
            let limit = windows.limit();
            let backfill = backfill(clip, group, joined, limit, fresh_from, material)?;
            *fill = ClipFill::Filling(backfill);
        }
        Ok(())
    }

    /// Continues in a next clip.
    pub fn roll(
        &mut self,
        boundary: i64,
        before: &Group,
        windows: &mut Windows,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        let (Some(CurrentClip { clip, .. }), Some(group)) = (&mut self.open, windows.open()) else {
            return Ok(());
        };
        if !clip.has_nothing() {
            let next = clip.next(group, self.disk.new_clip());
            let full = std::mem::replace(clip, next);
            self.end(full, before, CloseReason::Full(boundary), material)?;
        }
        let (Some(CurrentClip { clip, .. }), Some(group)) = (&self.open, windows.open()) else {
            return Ok(());
        };
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
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        match self.open.take() {
            Some(CurrentClip { clip, .. }) if !clip.is_pointless() => {
                self.end(clip, group, close, material)
            }
            _ => Ok(()),
        }
    }

    pub fn begin_late(
        &mut self,
        windows: Vec<Window>,
        group: Group,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        let clip = self.new_clip(&group, material);
        self.fill_late(clip, windows, group, material)
    }

    fn fill_late(
        &mut self,
        mut clip: OpenClip,
        windows: Vec<Window>,
        group: Group,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        let limit = group.from.saturating_add(self.max_length_ns);
        let backfill = backfill(&mut clip, &group, windows, limit, i64::MIN, material)?;
        self.late = Some(LateClip { clip, group, backfill });
        Ok(())
    }

    /// A late clip is backfilled: completes it, or continues in a next one.
    fn end_late(
        &mut self,
        late: LateClip,
        material: &mut RecorderContext,
    ) -> Result<(), RecordError> {
        let LateClip { mut clip, mut group, backfill } = late;
        let boundary = backfill.limit();
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
        material: &mut RecorderContext,
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

    fn new_clip(&mut self, group: &Group, material: &RecorderContext) -> OpenClip {
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
        let late = self.late.iter_mut().map(|late| &mut late.clip);
        let mut clips = self.open.iter_mut().map(|open| &mut open.clip).chain(late);
        clips.try_for_each(OpenClip::flush)
    }
}

/// Starts a backfill, and counts what is already lost.
fn backfill(
    clip: &mut OpenClip,
    group: &Group,
    windows: Vec<Window>,
    limit: i64,
    fresh_from: i64,
    material: &mut RecorderContext,
) -> Result<Backfill, RecordError> {
    let RecorderContext { sources, history } = material;
    windows.iter().for_each(|window| history.reach_back(clip, window, sources));
    history.count_losses(clip, group, sources, limit);
    history.begin_latched(clip, group, sources)?;
    Backfill::new(clip, group, windows, limit, fresh_from, sources)
}

/// The stamp of the earliest sample that is covered, but in no clip of the group.
fn earliest(clip: &OpenClip, group: &Group, material: &RecorderContext) -> Option<i64> {
    let RecorderContext { sources, history } = material;
    let preroll = &history.preroll;
    let mut earliest = None;
    let mut next = preroll.next(None);
    while let Some(place) = next.map(PrerollCursor::place) {
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
