//! Bringing into a clip what is held already: a way through the preroll from the oldest to the
//! newest, in steps, so that whoever records live is never busy with it for long.

use super::open_clip::OpenClip;
use super::state::{RecorderState, Settled};
use crate::RecordError;
use crate::preroll::{EntrySource, Walked};
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
pub(super) struct Backfill {
    /// Those for which it is made.
    windows: Vec<Window>,
    /// Nothing later is wanted.
    limit: i64,
    /// Up to which stamp all is settled behind it, if that is known.
    settles: Option<i64>,
    last: Option<Walked>,
    /// Comes first.
    thumbnail_search: Option<ThumbnailSearch>,
}

/// The search for the newest image that belongs into the clip and is not later than its trigger.
#[derive(Debug)]
struct ThumbnailSearch {
    topic: usize,
    until: i64,
    last: Option<Walked>,
    newest: Option<(i64, Walked)>,
}

impl Backfill {
    /// From behind `last` on, for messages that could not be written when they came.
    pub(super) fn from(last: Option<Walked>, limit: i64) -> Backfill {
        Backfill { windows: Vec::new(), limit, settles: None, last, thumbnail_search: None }
    }

    /// Starts again: the preroll lies elsewhere now.
    pub(super) fn restart(&mut self) {
        (self.last, self.settles) = (None, None);
        if let Some(thumbnail_search) = &mut self.thumbnail_search {
            (thumbnail_search.last, thumbnail_search.newest) = (None, None);
        }
    }
}

impl RecorderState {
    /// Begins to bring a clip up to what its group covers and what is held, not after `limit`.
    /// `windows` are those that have just joined the group; what is before `fresh_from` it has
    /// covered already.
    pub(super) fn settle(
        &mut self,
        open_clip: &mut OpenClip,
        group: &Group,
        windows: Vec<Window>,
        limit: i64,
        fresh_from: i64,
    ) -> Result<Backfill, RecordError> {
        windows.iter().for_each(|window| self.reach_back(open_clip, window));
        self.count_losses(open_clip, group, limit);
        let thumbnail_search = self.thumbnail_search(open_clip, group, limit)?;
        let settles = windows
            .iter()
            .map(|window| window.to.unwrap_or(i64::MAX))
            .max()
            .unwrap_or(group.to)
            .min(limit);
        open_clip.settled = open_clip.settled.filter(|settled| settled.newest < fresh_from);
        let last = open_clip.settled.map(|settled| settled.last);
        Ok(Backfill { windows, limit, settles: Some(settles), last, thumbnail_search })
    }

    /// The picture is made when a clip first has a topic with images. A clip that continues another
    /// takes its own first one.
    fn thumbnail_search(
        &mut self,
        open_clip: &mut OpenClip,
        group: &Group,
        limit: i64,
    ) -> Result<Option<ThumbnailSearch>, RecordError> {
        if open_clip.has_images {
            return Ok(None);
        }
        let images = self
            .context
            .topics_of(group)
            .into_iter()
            .find(|topic| self.context.topics[*topic].is_image());
        let Some(topic) = images else { return Ok(None) };
        open_clip.has_images = true;
        self.context.writer.images(open_clip.clip, topic)?;
        let thumbnail_search =
            ThumbnailSearch { topic, until: group.first.1.min(limit), last: None, newest: None };
        Ok((!open_clip.continues).then_some(thumbnail_search))
    }

    /// Goes on as far as `budget` reaches and the pen has room; `true` once all is done.
    pub(super) fn backfill(
        &mut self,
        backfill: &mut Backfill,
        open_clip: &mut OpenClip,
        group: &Group,
        budget: &mut Budget,
    ) -> Result<bool, RecordError> {
        if let Some(thumbnail_search) = &mut backfill.thumbnail_search {
            if !self.search(thumbnail_search, group, budget) {
                return Ok(false);
            }
            if let Some(place) =
                thumbnail_search.newest.and_then(|(_, newest)| self.preroll.find(newest))
            {
                let (meta, of) = (
                    self.preroll.held(place).meta(),
                    &self.context.topics[thumbnail_search.topic].topic,
                );
                self.context.writer.image(open_clip.clip, of, &meta, self.preroll.bytes(place)?)?;
            }
            backfill.thumbnail_search = None;
        }
        while let Some(walked) = self.preroll.next(backfill.last) {
            if budget.is_spent() || !self.context.writer.has_room() {
                return Ok(false);
            }
            let place = walked.place();
            let held = self.preroll.held(place);
            budget.entries -= 1;
            if self.wants(open_clip, group, &held, backfill.limit) {
                let bytes = self.preroll.bytes(place)?;
                budget.bytes = budget.bytes.saturating_sub(bytes.len());
                match held.source.lambda() {
                    Some(lambda) => open_clip.wake(lambda, held.seq, bytes),
                    None => {
                        let topic = held.source.as_topic().unwrap_or_default();
                        open_clip.message(&mut self.context, group, topic, &held.meta(), bytes)?;
                    }
                }
                self.preroll.mark(place, open_clip.group);
            }
            backfill.settles = backfill.settles.filter(|settles| held.at_ns <= *settles);
            if backfill.settles.is_some() {
                let newest =
                    open_clip.settled.map_or(held.at_ns, |settled| settled.newest.max(held.at_ns));
                open_clip.settled = Some(Settled { last: walked, newest });
            }
            backfill.last = Some(walked);
        }
        // What had to go meanwhile.
        backfill.windows.iter().for_each(|window| self.reach_back(open_clip, window));
        self.count_losses(open_clip, group, backfill.limit);
        self.gather(open_clip, group, backfill.limit);
        Ok(true)
    }

    /// Goes on searching; `true` once all was seen.
    fn search(
        &self,
        thumbnail_search: &mut ThumbnailSearch,
        group: &Group,
        budget: &mut Budget,
    ) -> bool {
        while let Some(walked) = self.preroll.next(thumbnail_search.last) {
            if budget.is_spent() {
                return false;
            }
            budget.entries -= 1;
            let held = self.preroll.held(walked.place());
            let is_newer = thumbnail_search.newest.is_none_or(|(at, _)| at <= held.at_ns);
            let is_ours = held.source == EntrySource::topic(thumbnail_search.topic)
                && self.context.covers(group, thumbnail_search.topic, held.at_ns);
            if is_ours && held.at_ns <= thumbnail_search.until && is_newer {
                thumbnail_search.newest = Some((held.at_ns, walked));
            }
            thumbnail_search.last = Some(walked);
        }
        true
    }
}
