//! Writes entries of the preroll to a clip, from the oldest to the newest, in steps, so that a live
//! recorder is never busy with it for long.

use super::open_clip::OpenClip;
use super::state::{RecorderState, Settled};
use crate::RecordError;
use crate::preroll::{EntrySource, Walked};
use crate::window::{Group, Window};

/// The amount of work of one step.
#[derive(Copy, Clone, Debug)]
pub(super) struct Budget {
    bytes: usize,
    entries: usize,
}

impl Budget {
    /// No limit.
    pub(super) const ALL: Budget = Budget { bytes: usize::MAX, entries: usize::MAX };
    /// No work.
    pub(super) const NONE: Budget = Budget { bytes: 0, entries: 0 };
    /// 0.1 to 0.2 ms, unless a single message takes longer.
    pub(super) const STEP: Budget = Budget { bytes: 256 << 10, entries: 1024 };

    fn is_spent(&self) -> bool {
        self.bytes == 0 || self.entries == 0
    }
}

/// A backfill in progress.
#[derive(Debug)]
pub(super) struct Backfill {
    /// The windows for which it is made.
    windows: Vec<Window>,
    /// Later entries are not needed.
    limit: i64,
    /// The stamp up to which all is settled after it, if known.
    settles: Option<i64>,
    last: Option<Walked>,
    /// The search for an image, which comes first.
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
    /// A backfill of the entries after `last`, for messages that could not be written when they
    /// came.
    pub(super) fn from(last: Option<Walked>, limit: i64) -> Backfill {
        Backfill { windows: Vec::new(), limit, settles: None, last, thumbnail_search: None }
    }

    /// Restarts, as the preroll has moved.
    pub(super) fn restart(&mut self) {
        (self.last, self.settles) = (None, None);
        if let Some(thumbnail_search) = &mut self.thumbnail_search {
            (thumbnail_search.last, thumbnail_search.newest) = (None, None);
        }
    }
}

impl RecorderState {
    /// Starts a backfill of the entries that a clip's group covers, not after `limit`. `windows`
    /// have just joined the group; entries before `fresh_from` were covered already.
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

    /// Starts the search for a thumbnail when a clip first has a topic with images. A clip that
    /// continues another takes its own first image.
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

    /// Continues as far as `budget` and the writer allow; `true` once it is done.
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
        // Entries that were evicted meanwhile.
        backfill.windows.iter().for_each(|window| self.reach_back(open_clip, window));
        self.count_losses(open_clip, group, backfill.limit);
        self.gather(open_clip, group, backfill.limit);
        Ok(true)
    }

    /// Continues the search; `true` once it is done.
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
