//! The progress of clips on their way to the cloud. It outlives connections: on a link that breaks
//! each of them, attempts, pauses and bytes would begin again otherwise.

use std::collections::BTreeMap;
use std::mem::replace;
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::text::describe;
use gleaner_base::{ByteSize, Failure};
use gleaner_fleet::clips::{CLIP_PART, CLIPS_IN_REPORT, ClipName, ClipOrders, WantedClip};
use gleaner_protocol::vehicle_api::{ClipsStatus, StuckClip};
use tokio::sync::Mutex;

use super::super::clip_list::{ClipReads, offset};

/// Pause after a failure; it doubles up to the longest, and progress resets it.
const PAUSE: Duration = Duration::from_millis(if cfg!(test) { 1 } else { 250 });
const PAUSE_MAX: Duration = Duration::from_secs(300);
/// Length of the first piece; it doubles with each that arrives, and is halved with any other one.
const PIECE_MIN: u64 = 64 << 10;
/// Attempts without progress after which it is reported.
const ATTEMPTS: u64 = 5;
/// Time after which an unreadable clip is read again, and the multiple of the time that this took,
/// before which none is: neither a bad disk nor many of these clips must keep others waiting.
const AGAIN: Duration = Duration::from_secs(if cfg!(test) { 0 } else { 20 });
pub(super) const AGAIN_FACTOR: u32 = 20;

/// A file of a clip: its name, and whether it is the thumbnail; `None` is the list of clips.
pub(super) type ClipKey = Option<(ClipName, bool)>;

#[derive(Default)]
pub(in super::super) struct ClipTracker {
    /// The newest orders.
    orders: ClipOrders,
    /// Length of the list of clips at the last look.
    length: Option<u64>,
    /// Attempts since the last progress.
    tries: BTreeMap<ClipKey, ClipTries>,
    /// Clips that cannot be read, with the time of the next look.
    unread: BTreeMap<ClipName, Instant>,
    /// Held by the thread that reads clips; with the time before which none is read again.
    pub(super) reads: Arc<Mutex<(ClipReads, Option<Instant>)>>,
    pause: Option<Duration>,
    piece: u64,
    /// Bytes of pieces and thumbnails that were begun in the day of the budget.
    sent: u64,
}

struct ClipTries {
    attempts: u64,
    since: Instant,
    cause: String,
    is_reported: bool,
}

impl ClipTracker {
    /// Takes note of orders, and of the length of the list. Only other orders are progress.
    pub(super) fn learn(&mut self, orders: &ClipOrders, length: u64) {
        self.length = Some(length);
        if self.orders == *orders {
            return;
        }
        self.pause = None;
        let Self { orders: before, unread, tries, .. } = self;
        for name in orders.unreadable.iter().take(CLIPS_IN_REPORT) {
            unread.entry(name.clone()).or_insert_with(|| Instant::now() + AGAIN);
        }
        // The cloud lists the others again later, unless it does not know yet that they are bad.
        if unread.len() > 2 * CLIPS_IN_REPORT {
            let wants = |name: &ClipName| orders.wanted.iter().any(|it| it.name == *name);
            unread.retain(|name, _| orders.unreadable.contains(name) || wants(name));
        }
        tries.retain(|file, _| match file {
            None => before.cursor == orders.cursor,
            Some((name, true)) => orders.thumbnails.contains(name),
            Some((name, false)) => {
                let mut same = orders.wanted.iter().filter(|it| before.wanted.contains(it));
                unread.contains_key(name) || same.any(|it| it.name == *name)
            }
        });
        let day = |orders: &ClipOrders| orders.budget.map(|budget| budget.day);
        if day(before) != day(orders) {
            self.sent = 0;
        }
        self.orders = orders.clone();
    }

    /// Notes that the cloud has the whole list.
    pub(super) fn listed(&mut self) {
        self.tries.remove(&None);
    }

    /// Returns the file to send next, with what is wanted of it unless it is a thumbnail: of those
    /// that can be read, the most important one of the fewest attempts.
    pub(super) fn next(&self) -> Option<(ClipName, Option<WantedClip>)> {
        if self.is_spent() {
            return None;
        }
        let tried = self.tries.iter().filter_map(|(key, it)| Some((key.as_ref()?, it.attempts)));
        let tried: BTreeMap<_, _> = tried.map(|((name, image), it)| ((name, *image), it)).collect();
        let thumbnails = self.orders.thumbnails.iter().map(|name| (name, None));
        let wanted = self.orders.wanted.iter().filter(|it| !self.unread.contains_key(&it.name));
        let all = thumbnails.chain(wanted.map(|it| (&it.name, Some(it))));
        let next = all.min_by_key(|(name, wanted)| tried.get(&(*name, wanted.is_none())));
        next.map(|(name, wanted)| (name.clone(), wanted.cloned()))
    }

    /// Counts an attempt as it begins, since it may be cut off with its task; returns the text of
    /// an event if those before it made no progress.
    pub(super) fn attempt(&mut self, file: ClipKey) -> Option<String> {
        let what = match &file {
            None => "the list of clips".to_owned(),
            Some((name, false)) => format!("clip `{name}`"),
            Some((name, true)) => format!("the thumbnail of clip `{name}`"),
        };
        let tries = self.tries(file);
        let attempts = tries.attempts;
        tries.attempts += 1;
        let is_new = attempts >= ATTEMPTS && !replace(&mut tries.is_reported, true);
        is_new.then(|| {
            let cause = &tries.cause;
            format!("{what} makes no progress to the cloud in {attempts} attempts: {cause}")
        })
    }

    /// Returns the length of the next piece.
    pub(super) fn piece(&mut self) -> u64 {
        let piece = self.piece.max(PIECE_MIN);
        self.piece = piece / 2;
        piece
    }

    /// Counts bytes that are sent, whether they arrive or not.
    pub(super) fn send(&mut self, bytes: u64) {
        self.sent += bytes;
    }

    pub(super) fn arrived(&mut self, piece: u64) {
        self.piece = (piece * 2).min(CLIP_PART);
    }

    /// Notes the failure of an attempt; returns the pause before the next one.
    pub(super) fn fail(&mut self, file: ClipKey, failure: &Failure) -> Duration {
        self.tries(file).cause = describe(&failure.message, &failure.causes);
        let pause = self.pause.unwrap_or(PAUSE);
        self.pause = Some((pause * 2).min(PAUSE_MAX));
        pause
    }

    /// Notes that a clip cannot be read; returns the text of an event.
    pub(super) fn not_read(&mut self, name: &ClipName, cause: &str) -> Option<String> {
        let is_new = self.unread.insert(name.clone(), Instant::now() + AGAIN).is_none();
        is_new.then(|| format!("clip `{name}` cannot be read, and is tried again: {cause}"))
    }

    /// Returns a clip to read again, or with an unused result, but not at once after a failure.
    pub(super) fn due(&mut self) -> Option<ClipName> {
        let now = Instant::now();
        let (reads, again) = &*self.reads.try_lock().ok()?;
        let due = self.unread.iter_mut().filter(|(name, _)| {
            *again <= Some(now) || reads.iter().any(|((known, ..), _)| known == *name)
        });
        let (name, at) = due.min_by_key(|(_, at)| **at)?;
        (*at <= now).then(|| {
            *at = now + AGAIN;
            name.clone()
        })
    }

    /// Notes that the cloud has what is new of a clip that could not be read.
    pub(super) fn announced(&mut self, name: &ClipName, is_readable: bool) {
        self.tries.remove(&Some((name.clone(), false)));
        if is_readable {
            self.unread.remove(name);
        }
    }

    /// Returns the state of the clips, as users see it.
    pub(in super::super) fn status(&self) -> ClipsStatus {
        let Self { orders, tries, unread, .. } = self;
        let stuck = tries.iter().filter(|(_, tries)| tries.attempts >= ATTEMPTS);
        ClipsStatus {
            unannounced_bytes: self.length.map(|length| {
                length.saturating_sub(orders.cursor.as_deref().and_then(offset).unwrap_or(0))
            }),
            waiting: orders.budget.filter(|it| !it.is_spent).map(|_| orders.wanted.len() as u64),
            unreadable: unread.len() as u64,
            paused: orders.budget.filter(|_| self.is_spent()).map(|budget| {
                let bytes = ByteSize::new(budget.bytes);
                format!("the {bytes} of today were sent; clips follow on the next day of UTC")
            }),
            stuck: stuck.max_by_key(|(_, tries)| tries.attempts).map(|(file, tries)| StuckClip {
                name: file.as_ref().map(|(name, _)| name.to_string()),
                attempts: tries.attempts,
                since_s: tries.since.elapsed().as_secs_f64(),
                cause: tries.cause.clone(),
            }),
        }
    }

    fn tries(&mut self, file: ClipKey) -> &mut ClipTries {
        self.tries.entry(file).or_insert_with(|| ClipTries {
            attempts: 0,
            since: Instant::now(),
            cause: "the connection ended".to_owned(),
            is_reported: false,
        })
    }

    /// Returns whether the cloud has the bytes of today, or more than these were sent: it may have
    /// received less.
    fn is_spent(&self) -> bool {
        self.orders.budget.is_some_and(|it| it.is_spent || self.sent >= it.bytes)
    }
}
