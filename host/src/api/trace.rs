//! What a journal notes of one topic: which samples came since the wake before, and how far back the lambda looked.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};

use gleaner_buffers::{Lease, RingCounts};
use gleaner_protocol::journal::Seen;
use gleaner_transport::SampleMeta;

use super::data::Topic;

/// No sample was looked at in this wake.
const NONE: u64 = u64::MAX;

/// What arrived at a ring, summed up by the thread that fills it.
#[derive(Default)]
pub struct Arrivals {
    wanted: AtomicBool,
    digest: AtomicU32,
}

impl Arrivals {
    /// Adds a sample that entered the ring, if anybody wants to know.
    pub fn add(&self, meta: &SampleMeta, cdr: &[u8]) {
        if self.wanted.load(Ordering::Relaxed) {
            self.digest.fetch_add(sample_digest(meta, cdr), Ordering::Relaxed);
        }
    }
}

/// CRC-32 of a sample, plus its stamps: any flipped byte changes it. The stamps are not worth a CRC of their own, which would
/// cost as much as that of a small sample.
fn sample_digest(meta: &SampleMeta, cdr: &[u8]) -> u32 {
    let fold = |stamp: i64| stamp as u32 ^ (stamp >> 32) as u32;
    let stamps = fold(meta.at_ns).wrapping_mul(3).wrapping_add(fold(meta.publish_ns).wrapping_mul(5));
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
    /// Notes the oldest of the samples that a call hands out.
    pub(super) fn at(&self, oldest: Option<&Lease<SampleMeta>>) {
        if let Some(position) = oldest.and_then(Lease::position)
            && position < self.0.load(Ordering::Relaxed)
        {
            self.0.store(position, Ordering::Relaxed);
        }
    }
}

/// Follows one topic from wake to wake.
///
/// What it reads here belongs together only while no sample arrives meanwhile, as in a replay. Where topics have threads of their
/// own, the ring has to be read as of one instant, and the lambda must see no more than that.
pub struct Trace {
    offered: u64,
    head: u64,
}

impl Trace {
    /// Begins with what is in the ring of `topic` now; from here on its samples are summed up.
    pub fn of(topic: &Topic) -> Self {
        topic.arrivals.wanted.store(true, Ordering::Relaxed);
        Self { offered: offered(topic), head: topic.reader().head() }
    }

    /// Before a wake: notes what came since the one before. If a sample of this topic wakes the lambda, `woken_by` is its place
    /// in the ring, and itself: most often it is the newest, and need not be looked for.
    pub fn begin(&mut self, topic: &Topic, woken_by: Option<(u64, &SampleMeta)>, seen: &mut Seen) {
        let offered = offered(topic);
        seen.new = offered - self.offered;
        self.offered = offered;
        let head = topic.reader().head();
        let arrived = head > self.head;
        self.head = head;
        if arrived {
            seen.digest = topic.arrivals.digest.swap(0, Ordering::Relaxed);
            let identity = |meta: &SampleMeta| (meta.writer.0, meta.seq);
            seen.newest = match woken_by {
                Some((position, meta)) if position + 1 == head => Some(identity(meta)),
                _ => topic.reader().newest().map(|lease| identity(lease.meta())),
            };
        } else {
            seen.digest = 0;
        }
        topic.looked.0.store(NONE, Ordering::Relaxed);
    }

    /// After a wake that `woken_by` caused, if it is a sample of this topic: notes how far back the lambda looked.
    pub fn end(&self, topic: &Topic, woken_by: Option<u64>, seen: &mut Seen) {
        let oldest = topic.looked.0.load(Ordering::Relaxed).min(woken_by.unwrap_or(NONE));
        seen.reach = self.head.saturating_sub(oldest);
    }
}
