//! What a journal notes of one topic: which samples came since the wake before, and how far back
//! the lambda looked.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};

use gleaner_buffers::{Lease, RingCounts};
use gleaner_journal::Seen;
use gleaner_transport::SampleMeta;

use super::data::Topic;

/// No sample was looked at in this wake.
const NONE: u64 = u64::MAX;

/// What arrived at a ring, summed up by the thread that fills it: as of each sample, so that a wake
/// can be told what it saw while further samples arrive.
pub struct Arrivals {
    wanted: AtomicBool,
    /// Changed by the filling thread only, as are those below.
    next: AtomicU64,
    digest: AtomicU32,
    refused: AtomicU64,
    marks: Box<[Mark]>,
}

/// What had arrived with a sample.
#[derive(Default)]
struct Mark {
    /// The lower half of its position in the ring, and the sum of digests.
    digest: AtomicU64,
    /// Samples that found no room before it.
    refused: AtomicU64,
}

/// Sums as of one sample.
#[derive(Copy, Clone)]
struct Sums {
    digest: u32,
    refused: u64,
}

impl Arrivals {
    /// For a ring of `depth`, which is still empty.
    pub fn new(depth: usize) -> Self {
        Self {
            wanted: AtomicBool::new(false),
            next: AtomicU64::new(0),
            digest: AtomicU32::new(0),
            refused: AtomicU64::new(0),
            // Twice the samples that a ring shows: a mark that is asked for was among them a moment
            // ago.
            marks: (0..2 * (depth + 1)).map(|_| Mark::default()).collect(),
        }
    }

    /// Adds a sample that is about to enter the ring.
    pub fn add(&self, meta: &SampleMeta, cdr: &[u8]) {
        let position = self.next.load(Ordering::Relaxed);
        self.next.store(position + 1, Ordering::Relaxed);
        if self.wanted.load(Ordering::Relaxed) {
            let digest = self.digest.load(Ordering::Relaxed).wrapping_add(sample_digest(meta, cdr));
            self.digest.store(digest, Ordering::Relaxed);
            let mark = &self.marks[(position % self.marks.len() as u64) as usize];
            mark.refused.store(self.refused.load(Ordering::Relaxed), Ordering::Relaxed);
            // The ring publishes the sample after this: who sees it there sees its mark.
            mark.digest.store(position << 32 | u64::from(digest), Ordering::Release);
        }
    }

    /// Adds a sample that found no room.
    pub fn refuse(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    /// The sums as of the sample at `position`; `None` if so many came since that they are gone.
    fn at(&self, position: u64) -> Option<Sums> {
        let mark = &self.marks[(position % self.marks.len() as u64) as usize];
        let digest = mark.digest.load(Ordering::Acquire);
        let refused = mark.refused.load(Ordering::Relaxed);
        (digest >> 32 == position & 0xffff_ffff).then_some(Sums { digest: digest as u32, refused })
    }

    fn now(&self) -> Sums {
        Sums {
            digest: self.digest.load(Ordering::Relaxed),
            refused: self.refused.load(Ordering::Relaxed),
        }
    }
}

/// CRC-32 of a sample, plus its stamps: any flipped byte changes it. The stamps are not worth a CRC
/// of their own, which would cost as much as that of a small sample.
fn sample_digest(meta: &SampleMeta, cdr: &[u8]) -> u32 {
    let fold = |stamp: i64| stamp as u32 ^ (stamp >> 32) as u32;
    let stamps =
        fold(meta.at_ns).wrapping_mul(3).wrapping_add(fold(meta.publish_ns).wrapping_mul(5));
    crc32fast::hash(cdr).wrapping_add(stamps)
}

/// Samples of `topic` so far, those included that found no room in its ring.
pub fn offered(topic: &Topic) -> u64 {
    let RingCounts { received, no_slot, too_big, .. } = topic.reader().counts();
    received + no_slot + too_big
}

/// How far back the lambda has looked in this wake. Written by its thread alone.
pub(super) struct Looked(AtomicU64);

impl Default for Looked {
    fn default() -> Self {
        Self(AtomicU64::new(NONE))
    }
}

impl Looked {
    pub(super) fn forget(&self) {
        self.0.store(NONE, Ordering::Relaxed);
    }

    /// Position of the oldest sample that was handed out.
    pub(super) fn oldest(&self) -> Option<u64> {
        Some(self.0.load(Ordering::Relaxed)).filter(|position| *position != NONE)
    }

    /// Notes the oldest of the samples that a call hands out.
    pub(super) fn at(&self, oldest: Option<&Lease<SampleMeta>>) {
        if let Some(position) = oldest.and_then(Lease::position) {
            self.at_position(position);
        }
    }

    pub(super) fn at_position(&self, position: u64) {
        if position < self.0.load(Ordering::Relaxed) {
            self.0.store(position, Ordering::Relaxed);
        }
    }
}

/// Follows one topic from wake to wake, by what the lambda may see of it.
pub struct Trace {
    offered: u64,
    until: u64,
    digest: u32,
}

impl Trace {
    /// Begins with what is in the ring of `topic` now; from here on its samples are summed up.
    pub fn of(topic: &Topic) -> Self {
        topic.arrivals.wanted.store(true, Ordering::Relaxed);
        Self { offered: offered(topic), until: topic.reader().head(), digest: 0 }
    }

    /// Before a wake: notes what came since the one before. If a sample of this topic wakes the
    /// lambda, `woken_by` is its place in the ring, and itself: most often it is the newest, and
    /// need not be looked for.
    pub fn begin(&mut self, topic: &Topic, woken_by: Option<(u64, &SampleMeta)>, seen: &mut Seen) {
        let head = topic.reader().head();
        let until = topic.until().min(head);
        // Where samples arrive meanwhile, only the mark of the last one that is seen tells what had
        // come with it.
        let is_still = topic.until() == u64::MAX;
        let sums = if is_still {
            None
        } else {
            until.checked_sub(1).and_then(|last| topic.arrivals.at(last))
        };
        let Sums { digest, refused } = sums.unwrap_or_else(|| topic.arrivals.now());
        let offered = (until + refused).max(self.offered);
        seen.new = offered - self.offered;
        self.offered = offered;
        let arrived = until > self.until;
        self.until = self.until.max(until);
        seen.digest = 0;
        if arrived {
            seen.digest = digest.wrapping_sub(self.digest);
            self.digest = digest;
            let identity = |meta: &SampleMeta| (meta.writer.0, meta.seq);
            seen.newest = match woken_by {
                Some((position, meta)) if position + 1 == until => Some(identity(meta)),
                _ => topic.reader().newest_before(until).map(|lease| identity(lease.meta())),
            };
        }
        topic.looked.forget();
    }

    /// After a wake that `woken_by` caused, if it is a sample of this topic: notes how far back the
    /// lambda looked.
    pub fn end(&self, topic: &Topic, woken_by: Option<u64>, seen: &mut Seen) {
        let oldest = topic.looked.0.load(Ordering::Relaxed).min(woken_by.unwrap_or(NONE));
        seen.reach = self.until.saturating_sub(oldest);
    }
}
