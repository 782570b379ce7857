//! Traces one topic for the journal: the samples since the previous wake, and how far back the
//! lambda looked.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};

use gleaner_buffers::{Lease, RingCounts};
use gleaner_journal::InputView;
use gleaner_transport::SampleMeta;

use super::data::Topic;

/// Value for a wake that looked at no sample.
const NONE: u64 = u64::MAX;

/// Sums over the samples that arrived at a ring, updated by the thread that fills it. They are kept
/// per sample, so that those of a wake are known while further samples arrive.
pub struct Arrivals {
    is_enabled: AtomicBool,
    /// Position of the next sample. Only the filling thread changes this and the fields below.
    next: AtomicU64,
    digest: AtomicU32,
    refused: AtomicU64,
    marks: Box<[ArrivalMark]>,
}

/// Sums up to and including a sample.
#[derive(Default)]
struct ArrivalMark {
    /// The lower half of its position in the ring, and the sum of digests.
    digest: AtomicU64,
    /// Number of samples refused before it.
    refused: AtomicU64,
}

/// Sums as of one sample.
#[derive(Copy, Clone)]
struct Sums {
    digest: u32,
    refused: u64,
}

impl Arrivals {
    /// Creates the sums of a ring of `depth`, which must still be empty.
    pub fn new(depth: usize) -> Self {
        Self {
            is_enabled: AtomicBool::new(false),
            next: AtomicU64::new(0),
            digest: AtomicU32::new(0),
            refused: AtomicU64::new(0),
            // Twice the visible samples: a requested mark belongs to a sample that was visible a
            // moment ago.
            marks: (0..2 * (depth + 1)).map(|_| ArrivalMark::default()).collect(),
        }
    }

    /// Adds a sample that is about to enter the ring.
    pub fn add(&self, meta: &SampleMeta, cdr: &[u8]) {
        let position = self.next.load(Ordering::Relaxed);
        self.next.store(position + 1, Ordering::Relaxed);
        if self.is_enabled.load(Ordering::Relaxed) {
            let digest = self.digest.load(Ordering::Relaxed).wrapping_add(sample_digest(meta, cdr));
            self.digest.store(digest, Ordering::Relaxed);
            let mark = &self.marks[(position % self.marks.len() as u64) as usize];
            mark.refused.store(self.refused.load(Ordering::Relaxed), Ordering::Relaxed);
            // The ring publishes the sample after this, so a reader of the sample sees its mark.
            mark.digest.store(position << 32 | u64::from(digest), Ordering::Release);
        }
    }

    /// Counts a refused sample.
    pub fn refuse(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    /// The sums up to the sample at `position`; `None` if newer samples have overwritten them.
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

/// CRC-32 of a sample, plus its stamps: any changed byte changes it. A CRC of the stamps would cost
/// as much as that of a small sample.
fn sample_digest(meta: &SampleMeta, cdr: &[u8]) -> u32 {
    let fold = |stamp: i64| stamp as u32 ^ (stamp >> 32) as u32;
    let stamps =
        fold(meta.at_ns).wrapping_mul(3).wrapping_add(fold(meta.publish_ns).wrapping_mul(5));
    crc32fast::hash(cdr).wrapping_add(stamps)
}

/// Number of samples of `topic` so far, including refused ones.
pub fn offered(topic: &Topic) -> u64 {
    let RingCounts { received, no_slot, too_big, .. } = topic.reader().counts();
    received + no_slot + too_big
}

/// The oldest sample at which the lambda has looked in this wake. Only its thread writes it.
pub(super) struct LookBack(AtomicU64);

impl Default for LookBack {
    fn default() -> Self {
        Self(AtomicU64::new(NONE))
    }
}

impl LookBack {
    pub(super) fn reset(&self) {
        self.0.store(NONE, Ordering::Relaxed);
    }

    /// Position of the oldest sample that a call returned.
    pub(super) fn oldest(&self) -> Option<u64> {
        Some(self.0.load(Ordering::Relaxed)).filter(|position| *position != NONE)
    }

    /// Notes the oldest of the samples that a call returns.
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

/// Traces the visible samples of one topic from wake to wake.
pub struct Trace {
    offered: u64,
    until: u64,
    digest: u32,
}

impl Trace {
    /// Starts the trace: the samples of `topic` are summed up from now on.
    pub fn of(topic: &Topic) -> Self {
        topic.arrivals.is_enabled.store(true, Ordering::Relaxed);
        Self { offered: offered(topic), until: topic.reader().head(), digest: 0 }
    }

    /// Notes the samples since the previous wake; call it before each wake. If a sample of this
    /// topic causes the wake, `woken_by` has its position in the ring and its metadata, which saves
    /// a lookup if it is the newest.
    pub fn begin(
        &mut self,
        topic: &Topic,
        woken_by: Option<(u64, &SampleMeta)>,
        seen: &mut InputView,
    ) {
        let head = topic.reader().head();
        let until = topic.until().min(head);
        // Where samples arrive during the wake, only the mark of the last visible one has the sums.
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
        topic.look_back.reset();
    }

    /// Notes how far back the lambda looked; call it after each wake. `woken_by` is the position of
    /// the sample that caused it, if it is one of this topic.
    pub fn end(&self, topic: &Topic, woken_by: Option<u64>, seen: &mut InputView) {
        let oldest = topic.look_back.0.load(Ordering::Relaxed).min(woken_by.unwrap_or(NONE));
        seen.reach = self.until.saturating_sub(oldest);
    }
}
