//! Writes entries of the preroll to a clip, from the oldest to the newest, in steps, so that a live
//! recorder is never busy with it for long.

use super::open_clip::OpenClip;
use crate::RecordError;
use crate::preroll::{EntrySource, Preroll, PrerollCursor};
use crate::recorder::sources::RecordedSources;
use crate::recorder::writer::ClipDisk;
use crate::window::{Group, Window};

/// The amount of work of one step.
#[derive(Copy, Clone, Debug)]
pub struct Budget {
    bytes: usize,
    entries: usize,
}

impl Budget {
    pub const ALL: Budget = Budget { bytes: usize::MAX, entries: usize::MAX };
    pub const NONE: Budget = Budget { bytes: 0, entries: 0 };
    /// 0.1 to 0.2 ms, unless a single message takes longer.
    pub const STEP: Budget = Budget { bytes: 256 << 10, entries: 1024 };

    fn is_spent(&self) -> bool {
        self.bytes == 0 || self.entries == 0
    }
}

#[derive(Debug)]
pub struct Backfill {
    windows: Vec<Window>,
    /// Later entries are not needed.
    limit: i64,
    /// The stamp up to which all is settled after it, if known.
    settles: Option<i64>,
    last: Option<PrerollCursor>,
    /// The search for an image, which comes first.
    thumbnail_search: Option<ThumbnailSearch>,
}

/// The search for the newest image that belongs into the clip and is not later than its trigger.
#[derive(Debug)]
struct ThumbnailSearch {
    topic: usize,
    until: i64,
    last: Option<PrerollCursor>,
    newest: Option<(i64, PrerollCursor)>,
}

impl Backfill {
    /// A backfill of the entries that a clip's group covers, not after `limit`. `windows` have just
    /// joined the group; entries before `fresh_from` were covered already.
    pub fn new(
        clip: &mut OpenClip,
        group: &Group,
        windows: Vec<Window>,
        limit: i64,
        fresh_from: i64,
        sources: &RecordedSources,
    ) -> Result<Backfill, RecordError> {
        let until = group.first.1.min(limit);
        let search = |topic| ThumbnailSearch { topic, until, last: None, newest: None };
        let thumbnail_search = clip.choose_thumbnail(group, sources)?.map(search);
        let ends = windows.iter().map(|window| window.to.unwrap_or(i64::MAX));
        let settles = Some(ends.max().unwrap_or(group.to).min(limit));
        let last = clip.settled_before(fresh_from);
        Ok(Backfill { windows, limit, settles, last, thumbnail_search })
    }

    /// A backfill of the entries after `last`, for messages that could not be written when they
    /// came.
    pub fn after(last: Option<PrerollCursor>, limit: i64) -> Backfill {
        Backfill { windows: Vec::new(), limit, settles: None, last, thumbnail_search: None }
    }

    pub fn restart(&mut self) {
        (self.last, self.settles) = (None, None);
        if let Some(thumbnail_search) = &mut self.thumbnail_search {
            (thumbnail_search.last, thumbnail_search.newest) = (None, None);
        }
    }

    pub fn windows(&self) -> &[Window] {
        &self.windows
    }

    /// The latest stamp of its entries.
    pub fn limit(&self) -> i64 {
        self.limit
    }

    /// Continues as far as `budget` and the disk allow; `true` once it is done.
    pub fn step(
        &mut self,
        clip: &mut OpenClip,
        group: &Group,
        sources: &RecordedSources,
        preroll: &mut Preroll,
        disk: &ClipDisk,
        budget: &mut Budget,
    ) -> Result<bool, RecordError> {
        if let Some(search) = &mut self.thumbnail_search {
            if !search.step(group, sources, preroll, budget) {
                return Ok(false);
            }
            if let Some(place) = search.newest.and_then(|(_, newest)| preroll.find(newest)) {
                let meta = preroll.held(place).meta();
                clip.thumbnail(search.topic, &meta, preroll.bytes(place)?, sources)?;
            }
            self.thumbnail_search = None;
        }
        while let Some(walked) = preroll.next(self.last) {
            if budget.is_spent() || !disk.has_room() {
                return Ok(false);
            }
            let place = walked.place();
            let held = preroll.held(place);
            budget.entries -= 1;
            if clip.lacks(&held, group, self.limit, sources) {
                let bytes = preroll.bytes(place)?;
                budget.bytes = budget.bytes.saturating_sub(bytes.len());
                match held.source.lambda() {
                    Some(lambda) => clip.journals().push(lambda, held.seq, bytes),
                    None => {
                        let topic = held.source.as_topic().unwrap_or_default();
                        clip.write(topic, &held.meta(), bytes, group, sources)?;
                    }
                }
                preroll.mark(place, clip.group());
            }
            self.settles = self.settles.filter(|settles| held.at_ns <= *settles);
            if self.settles.is_some() {
                clip.settle(walked, held.at_ns);
            }
            self.last = Some(walked);
        }
        Ok(true)
    }
}

impl ThumbnailSearch {
    /// Continues the search; `true` once it is done.
    fn step(
        &mut self,
        group: &Group,
        sources: &RecordedSources,
        preroll: &Preroll,
        budget: &mut Budget,
    ) -> bool {
        while let Some(walked) = preroll.next(self.last) {
            if budget.is_spent() {
                return false;
            }
            budget.entries -= 1;
            let held = preroll.held(walked.place());
            let is_newer = self.newest.is_none_or(|(at, _)| at <= held.at_ns);
            let is_ours = held.source == EntrySource::topic(self.topic)
                && sources.covers(group, self.topic, held.at_ns);
            if is_ours && held.at_ns <= self.until && is_newer {
                self.newest = Some((held.at_ns, walked));
            }
            self.last = Some(walked);
        }
        true
    }
}
