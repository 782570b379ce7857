//! The reading end of a ring: over slots of this process, or over shared memory.

use std::fmt;
use std::ops::ControlFlow;

use crate::{
    Lease, RingCounts,
    ring::RingState,
    shared::{META_WORDS, SharedReader, SharedRing},
    sync::Arc,
};

/// A reading end of a ring; clones read the same ring, each from any thread.
pub struct RingReader<M>(RingKind<M>);

enum RingKind<M> {
    Heap(Arc<RingState<M>>),
    Shared(Arc<SharedRing<M>>),
}

impl<M> RingReader<M> {
    /// The reading end of a ring over a pool.
    pub(crate) fn heap(ring: Arc<RingState<M>>) -> Self {
        Self(RingKind::Heap(ring))
    }

    /// The reading end of a ring that another process writes to shared memory.
    ///
    /// Its position 0 is position `first` of `reader`, and it shows the newest `depth` samples, or
    /// as many as the topic shows. `decode` converts the words beside a sample, which another
    /// process wrote. `too_big` returns the number of samples that were too large, from the
    /// counters of the topic; `too_big_before` of them were before `first`.
    pub fn shared(
        reader: SharedReader,
        first: u64,
        depth: usize,
        decode: fn(&[u64; META_WORDS]) -> M,
        too_big: fn(&SharedReader) -> u64,
        too_big_before: u64,
    ) -> Self
    where
        M: 'static,
    {
        let ring = SharedRing::new(reader, first, depth, decode, too_big, too_big_before);
        Self(RingKind::Shared(Arc::new(ring)))
    }

    /// Continues a ring over shared memory in other memory, whose position `first` follows the
    /// newest position so far. The other arguments are those of [`shared`](Self::shared). Nothing
    /// may write to the earlier memory any more; its samples stay in the ring until newer ones
    /// replace them.
    ///
    /// Does nothing for a ring over a pool.
    pub fn continue_in(
        &self,
        reader: SharedReader,
        first: u64,
        too_big_before: u64,
        decode: impl Fn(&[u64; META_WORDS]) -> M + Send + Sync + 'static,
    ) {
        if let RingKind::Shared(ring) = &self.0 {
            ring.continue_in(reader, first, too_big_before, Box::new(decode));
        }
    }

    /// Returns whether another process fills the ring, over shared memory.
    pub fn is_shared(&self) -> bool {
        matches!(self.0, RingKind::Shared(_))
    }

    /// Drops earlier memory that has no sample of the ring any more. Held samples stay.
    pub fn drop_left(&self) {
        if let RingKind::Shared(ring) = &self.0 {
            ring.drop_left();
        }
    }

    /// Returns the number of samples published so far: the position of the next one.
    pub fn head(&self) -> u64 {
        match &self.0 {
            RingKind::Heap(ring) => ring.head(),
            RingKind::Shared(ring) => ring.head(),
        }
    }

    /// Returns the maximum number of samples in the ring.
    pub fn depth(&self) -> usize {
        match &self.0 {
            RingKind::Heap(ring) => ring.depth() as usize,
            RingKind::Shared(ring) => ring.depth() as usize,
        }
    }

    /// Returns the sample at `position`; `None` if it has left the ring, or is not published yet.
    pub fn get(&self, position: u64) -> Option<Lease<M>> {
        let age = self.head().checked_sub(position)?;
        if !(1..=self.depth() as u64).contains(&age) {
            return None;
        }
        match &self.0 {
            RingKind::Heap(ring) => ring.at(position),
            RingKind::Shared(ring) => ring.at(position),
        }
    }

    /// Returns the metadata of the sample at `position`, as [`RingReader::get`], but without a
    /// hold in shared memory.
    pub fn meta(&self, position: u64) -> Option<M>
    where
        M: Clone,
    {
        match &self.0 {
            RingKind::Heap(_) => self.get(position).map(|lease| lease.meta().clone()),
            RingKind::Shared(ring) => ring.meta(position),
        }
    }

    /// Returns position and metadata of the newest sample, without a hold in shared memory.
    pub fn newest_meta(&self) -> Option<(u64, M)>
    where
        M: Clone,
    {
        match &self.0 {
            RingKind::Heap(ring) => {
                ring.newest_at(u64::MAX).map(|(lease, position)| (position, lease.meta().clone()))
            }
            RingKind::Shared(ring) => ring.newest_meta(),
        }
    }

    /// Returns the newest sample; `None` only if the ring was empty at some moment during the call.
    pub fn newest(&self) -> Option<Lease<M>> {
        self.newest_before(u64::MAX)
    }

    /// As [`RingReader::newest`], among the samples at positions below `end`.
    pub fn newest_before(&self, end: u64) -> Option<Lease<M>> {
        match &self.0 {
            RingKind::Heap(ring) => ring.newest_at(end).map(|(lease, _)| lease),
            RingKind::Shared(ring) => ring.newest_before(end),
        }
    }

    /// Fills `out` with the newest `n` samples, fewer if the ring has fewer, oldest first.
    ///
    /// Samples that leave the ring during the call may be missing, but never the newest one.
    pub fn last(&self, n: usize, out: &mut Vec<Lease<M>>) {
        self.newest_while(n, |_| true, out);
    }

    /// As [`RingReader::last`], among the samples at positions below `end`.
    pub fn last_before(&self, end: u64, n: usize, out: &mut Vec<Lease<M>>) {
        self.newest_while_before(end, n, |_| true, out);
    }

    /// Fills `out` with the newest samples, at most `max`, back to the first one that `keep`
    /// refuses; oldest first.
    ///
    /// Evicted positions are skipped. `keep` is called newest first.
    pub fn newest_while(&self, max: usize, keep: impl FnMut(&M) -> bool, out: &mut Vec<Lease<M>>) {
        self.newest_while_before(u64::MAX, max, keep, out);
    }

    /// As [`RingReader::newest_while`], among the samples at positions below `end`.
    pub fn newest_while_before(
        &self,
        end: u64,
        max: usize,
        keep: impl FnMut(&M) -> bool,
        out: &mut Vec<Lease<M>>,
    ) {
        out.clear();
        match &self.0 {
            RingKind::Heap(ring) => ring.newest_while(end, max, keep, out),
            RingKind::Shared(ring) => ring.newest_while(end, max, keep, out),
        }
    }

    /// Shows the samples of [`RingReader::newest_while_before`] to `visit`, newest first, with
    /// position, metadata and bytes, until it breaks.
    ///
    /// This costs less than leases; nothing is held afterwards.
    pub fn visit_while_before(
        &self,
        end: u64,
        max: usize,
        keep: impl FnMut(&M) -> bool,
        visit: impl FnMut(u64, &M, &[u8]) -> ControlFlow<()>,
    ) {
        match &self.0 {
            RingKind::Heap(ring) => ring.visit_while(end, max, keep, visit),
            RingKind::Shared(ring) => ring.visit_while(end, max, keep, visit),
        }
    }

    pub fn counts(&self) -> RingCounts {
        match &self.0 {
            RingKind::Heap(ring) => ring.counts(),
            RingKind::Shared(ring) => ring.counts(),
        }
    }

    /// Returns the number of reads that returned no sample because this process may hold no more.
    ///
    /// 0 for a ring over a pool, which refuses new samples instead.
    pub fn refused_holds(&self) -> u64 {
        match &self.0 {
            RingKind::Heap(_) => 0,
            RingKind::Shared(ring) => ring.refused_holds(),
        }
    }
}

impl<M> Clone for RingReader<M> {
    fn clone(&self) -> Self {
        Self(match &self.0 {
            RingKind::Heap(ring) => RingKind::Heap(Arc::clone(ring)),
            RingKind::Shared(ring) => RingKind::Shared(Arc::clone(ring)),
        })
    }
}

impl<M> fmt::Debug for RingReader<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RingReader")
            .field("depth", &self.depth())
            .field("counts", &self.counts())
            .finish_non_exhaustive()
    }
}
