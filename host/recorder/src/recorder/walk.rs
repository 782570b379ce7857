//! Bringing into a clip what is held already: a way through the preroll from the oldest to the
//! newest, in steps, so that whoever records live is never busy with it for long.

use super::draft::Draft;
use super::stock::{Settled, Stock};
use crate::RecordError;
use crate::preroll::{Source, Walked};
use crate::window::{Group, Window};

/// How much of a walk is done at once.
#[derive(Copy, Clone, Debug)]
pub(super) struct Budget {
    bytes: usize,
    entries: usize,
}

impl Budget {
    /// All of it.
    pub(super) const ALL: Budget = Budget { bytes: usize::MAX, entries: usize::MAX };
    /// Nothing.
    pub(super) const NONE: Budget = Budget { bytes: 0, entries: 0 };
    /// A tenth of a millisecond or two, unless a single message takes longer.
    pub(super) const STEP: Budget = Budget { bytes: 256 << 10, entries: 1024 };

    fn is_spent(&self) -> bool {
        self.bytes == 0 || self.entries == 0
    }
}

/// A walk that is under way.
#[derive(Debug)]
pub(super) struct Walk {
    /// Those for which it is made.
    windows: Vec<Window>,
    /// Nothing later is wanted.
    limit: i64,
    /// Up to which stamp all is settled behind it, if that is known.
    settles: Option<i64>,
    last: Option<Walked>,
    /// Comes first.
    look: Option<Look>,
}

/// The search for the newest image that belongs into the clip and is not later than its trigger.
#[derive(Debug)]
struct Look {
    topic: usize,
    until: i64,
    last: Option<Walked>,
    newest: Option<(i64, Walked)>,
}

impl Walk {
    /// From behind `last` on, for messages that could not be written when they came.
    pub(super) fn from(last: Option<Walked>, limit: i64) -> Walk {
        Walk { windows: Vec::new(), limit, settles: None, last, look: None }
    }

    /// Starts again: the preroll lies elsewhere now.
    pub(super) fn restart(&mut self) {
        (self.last, self.settles) = (None, None);
        if let Some(look) = &mut self.look {
            (look.last, look.newest) = (None, None);
        }
    }
}

impl Stock {
    /// Begins to bring a clip up to what its group covers and what is held, not after `limit`.
    /// `windows` are those that have just joined the group; what is before `fresh_from` it has
    /// covered already.
    pub(super) fn settle(
        &mut self,
        draft: &mut Draft,
        group: &Group,
        windows: Vec<Window>,
        limit: i64,
        fresh_from: i64,
    ) -> Result<Walk, RecordError> {
        windows.iter().for_each(|window| self.reach_back(draft, window));
        self.count_losses(draft, group, limit);
        let look = self.look(draft, group, limit)?;
        let settles = windows
            .iter()
            .map(|window| window.to.unwrap_or(i64::MAX))
            .max()
            .unwrap_or(group.to)
            .min(limit);
        draft.settled = draft.settled.filter(|settled| settled.newest < fresh_from);
        let last = draft.settled.map(|settled| settled.last);
        Ok(Walk { windows, limit, settles: Some(settles), last, look })
    }

    /// The picture is made when a clip first has a topic with images. A clip that continues another
    /// takes its own first one.
    fn look(
        &mut self,
        draft: &mut Draft,
        group: &Group,
        limit: i64,
    ) -> Result<Option<Look>, RecordError> {
        if draft.has_images {
            return Ok(None);
        }
        let images =
            self.desk.topics_of(group).into_iter().find(|topic| self.desk.lanes[*topic].is_image());
        let Some(topic) = images else { return Ok(None) };
        draft.has_images = true;
        self.desk.pen.images(draft.clip, topic)?;
        let look = Look { topic, until: group.first.1.min(limit), last: None, newest: None };
        Ok((!draft.continues).then_some(look))
    }

    /// Goes on as far as `budget` reaches and the pen has room; `true` once all is done.
    pub(super) fn walk(
        &mut self,
        walk: &mut Walk,
        draft: &mut Draft,
        group: &Group,
        budget: &mut Budget,
    ) -> Result<bool, RecordError> {
        if let Some(look) = &mut walk.look {
            if !self.search(look, group, budget) {
                return Ok(false);
            }
            if let Some(place) = look.newest.and_then(|(_, newest)| self.preroll.find(newest)) {
                let (meta, of) =
                    (self.preroll.held(place).meta(), &self.desk.lanes[look.topic].topic);
                self.desk.pen.image(draft.clip, of, &meta, self.preroll.bytes(place)?)?;
            }
            walk.look = None;
        }
        while let Some(walked) = self.preroll.next(walk.last) {
            if budget.is_spent() || !self.desk.pen.has_room() {
                return Ok(false);
            }
            let place = walked.place();
            let held = self.preroll.held(place);
            budget.entries -= 1;
            if self.wants(draft, group, &held, walk.limit) {
                let bytes = self.preroll.bytes(place)?;
                budget.bytes = budget.bytes.saturating_sub(bytes.len());
                match held.source.lambda() {
                    Some(lambda) => draft.wake(lambda, held.seq, bytes),
                    None => {
                        let topic = held.source.as_topic().unwrap_or_default();
                        draft.message(&mut self.desk, group, topic, &held.meta(), bytes)?;
                    }
                }
                self.preroll.mark(place, draft.group);
            }
            walk.settles = walk.settles.filter(|settles| held.at_ns <= *settles);
            if walk.settles.is_some() {
                let newest =
                    draft.settled.map_or(held.at_ns, |settled| settled.newest.max(held.at_ns));
                draft.settled = Some(Settled { last: walked, newest });
            }
            walk.last = Some(walked);
        }
        // What had to go meanwhile.
        walk.windows.iter().for_each(|window| self.reach_back(draft, window));
        self.count_losses(draft, group, walk.limit);
        self.gather(draft, group, walk.limit);
        Ok(true)
    }

    /// Goes on searching; `true` once all was seen.
    fn search(&self, look: &mut Look, group: &Group, budget: &mut Budget) -> bool {
        while let Some(walked) = self.preroll.next(look.last) {
            if budget.is_spent() {
                return false;
            }
            budget.entries -= 1;
            let held = self.preroll.held(walked.place());
            let is_newer = look.newest.is_none_or(|(at, _)| at <= held.at_ns);
            let is_ours = held.source == Source::topic(look.topic)
                && self.desk.covers(group, look.topic, held.at_ns);
            if is_ours && held.at_ns <= look.until && is_newer {
                look.newest = Some((held.at_ns, walked));
            }
            look.last = Some(walked);
        }
        true
    }
}
