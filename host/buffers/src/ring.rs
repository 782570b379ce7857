//! Keeps the newest samples of one writer, by position.
//!
//! A ring of depth `d` has `d + 1` places. A place names a slot on which the ring owns one hold, or
//! is empty. The writer fills the spare place, then raises `head`, and only then empties the place
//! of the sample that leaves. A reader that misses the newest sample therefore sees a higher
//! `head`, or knows that the sample was evicted.
#![allow(unsafe_code)]

use std::{error::Error, fmt, ops::ControlFlow};

use crate::{
    Draft, DraftError, Lease, Pool, PoolError, RingReader,
    pool::RingStamp,
    sync::{Arc, AtomicU32, AtomicU64, Ordering},
};

/// A place without a slot. Pools have fewer than 2^31 slots.
const EMPTY: u32 = u32::MAX;

/// Creates a ring that shows the newest `depth` samples, over slots of `pool`.
///
/// Rings may share a pool; each evicts only its own samples. The crate docs state how many slots
/// are enough.
///
/// # Errors
///
/// [`PoolError::Depth`] unless `depth` is 1 to `pool.slots()`.
pub fn ring<M>(pool: Pool<M>, depth: usize) -> Result<(RingWriter<M>, RingReader<M>), PoolError> {
    let slots = pool.slots();
    if depth == 0 || depth > slots {
        return Err(PoolError::Depth { depth, slots });
    }
    let shared = Arc::new(RingState {
        id: pool.next_ring(),
        pool,
        places: (0..=depth).map(|_| AtomicU32::new(EMPTY)).collect(),
        head: AtomicU64::new(0),
        overwritten: AtomicU64::new(0),
        no_slot: AtomicU64::new(0),
        too_big: AtomicU64::new(0),
    });
    let writer = RingWriter { shared: Arc::clone(&shared), head: 0 };
    Ok((writer, RingReader::heap(shared)))
}

/// Numbers of samples that a ring has received and lost since it was built. They never decrease.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RingCounts {
    /// Samples published.
    pub received: u64,
    /// Published samples that have left the ring, replaced or evicted; never more than `received`.
    pub overwritten: u64,
    /// Drafts refused because every slot was in use.
    pub no_slot: u64,
    /// Drafts refused because the sample was larger than a slot.
    pub too_big: u64,
}

/// The draft belongs to another pool. Nothing was published; the caller gets the draft back.
pub struct ForeignDraft<M>(pub Draft<M>);

impl<M> fmt::Debug for ForeignDraft<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("ForeignDraft").field(&self.0).finish()
    }
}

impl<M> fmt::Display for ForeignDraft<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "draft belongs to another pool than the ring")
    }
}

impl<M> Error for ForeignDraft<M> {}

pub(crate) struct RingState<M> {
    id: u64,
    pool: Pool<M>,
    /// Changed by the one writer only, and on drop.
    places: Box<[AtomicU32]>,
    /// Number of samples published. Changed by the writer only, as are the counts.
    head: AtomicU64,
    overwritten: AtomicU64,
    no_slot: AtomicU64,
    too_big: AtomicU64,
}

impl<M> RingState<M> {
    pub(crate) fn head(&self) -> u64 {
        self.head.load(Ordering::Acquire)
    }

    pub(crate) fn depth(&self) -> u64 {
        self.places.len() as u64 - 1
    }

    fn place(&self, position: u64) -> &AtomicU32 {
        &self.places[(position % self.places.len() as u64) as usize]
    }

    /// Returns the sample at a position below a `head` that the caller has loaded, if it is still
    /// there.
    pub(crate) fn at(&self, position: u64) -> Option<Lease<M>> {
        // That load of `head` shows the place as it was filled, or later. Acquire shows why the
        // sample left: see `newest_at`.
        let index = self.place(position).load(Ordering::Acquire);
        (index != EMPTY).then(|| self.pool.pin(index, self.stamp(position)))?
    }

    /// As [`at`](Self::at), without a hold beyond the call of `read`.
    fn read<T>(&self, position: u64, read: impl FnOnce(&M, &[u8]) -> T) -> Option<T> {
        let index = self.place(position).load(Ordering::Acquire);
        (index != EMPTY).then(|| self.pool.read(index, self.stamp(position), read))?
    }

    fn stamp(&self, position: u64) -> RingStamp {
        RingStamp { ring: self.id, position }
    }

    /// Returns the newest sample below position `end`, and its position.
    ///
    /// A sample that leaves during the call either was evicted, and then the one before it is the
    /// newest, or was followed by others; then `head` is higher and the search restarts there. Each
    /// restart takes a sample that was published during the call, and between two restarts there
    /// are at most `depth` steps. So the call ends unless the writer is forever as fast as the few
    /// instructions of a step.
    pub(crate) fn newest_at(&self, end: u64) -> Option<(Lease<M>, u64)> {
        let mut head = self.head().min(end);
        let mut back = 1;
        while back <= head.min(self.depth()) {
            let position = head - back;
            if let Some(lease) = self.at(position) {
                return Some((lease, position));
            }
            // The place or the count showed, by an Acquire load, that the sample is gone. So all
            // that the writer did before is visible: a publication that replaced the sample, or
            // preceded its eviction, raised `head`, and this load sees it.
            let now = self.head().min(end);
            back = if now == head { back + 1 } else { 1 };
            head = now;
        }
        None
    }

    pub(crate) fn newest_while(
        &self,
        end: u64,
        max: usize,
        mut keep: impl FnMut(&M) -> bool,
        out: &mut Vec<Lease<M>>,
    ) {
        if max == 0 {
            return;
        }
        let Some((newest, position)) = self.newest_at(end) else {
            return;
        };
        let oldest = (position + 1).saturating_sub(self.depth());
        let older = (oldest..position).rev().filter_map(|older| self.at(older));
        out.extend(
            std::iter::once(newest).chain(older).take_while(|lease| keep(lease.meta())).take(max),
        );
        out.reverse();
    }

    /// Shows the samples of [`newest_while`](Self::newest_while) to `visit`, newest first, until
    /// it breaks. None is held beyond its call.
    pub(crate) fn visit_while(
        &self,
        end: u64,
        max: usize,
        mut keep: impl FnMut(&M) -> bool,
        mut visit: impl FnMut(u64, &M, &[u8]) -> ControlFlow<()>,
    ) {
        if max == 0 {
            return;
        }
        let Some((newest, position)) = self.newest_at(end) else {
            return;
        };
        let mut show = |position, meta: &M, bytes: &[u8]| {
            if keep(meta) { visit(position, meta, bytes) } else { ControlFlow::Break(()) }
        };
        let shown = show(position, newest.meta(), &newest);
        drop(newest);
        if shown.is_break() {
            return;
        }
        let oldest = (position + 1).saturating_sub(self.depth());
        let mut left = max - 1;
        for older in (oldest..position).rev() {
            if left == 0 {
                return;
            }
            let shown = self.read(older, |meta, bytes| show(older, meta, bytes));
            left -= usize::from(shown.is_some());
            if shown.is_some_and(|shown| shown.is_break()) {
                return;
            }
        }
    }

    pub(crate) fn counts(&self) -> RingCounts {
        // First `overwritten`, then `received`, so that the difference is never negative.
        let overwritten = self.overwritten.load(Ordering::Acquire);
        RingCounts {
            received: self.head(),
            overwritten,
            no_slot: self.no_slot.load(Ordering::Relaxed),
            too_big: self.too_big.load(Ordering::Relaxed),
        }
    }

    /// Counts a sample that has left. Release: a thread that sees the count also sees the matching
    /// `head`.
    fn count_overwritten(&self) {
        self.overwritten.fetch_add(1, Ordering::Release);
    }
}

impl<M> Drop for RingState<M> {
    fn drop(&mut self) {
        for place in &self.places {
            let index = place.load(Ordering::Relaxed);
            if index != EMPTY {
                // SAFETY: a place that is not empty stands for one hold, and no other code uses the
                // places any more.
                unsafe { self.pool.release(index) };
            }
        }
    }
}

/// The writing end of a ring. There is only one, so every method that writes takes `&mut self`.
///
/// Samples stay readable after it is dropped.
pub struct RingWriter<M> {
    shared: Arc<RingState<M>>,
    /// The writer's own copy of the shared `head`.
    head: u64,
}

impl<M> RingWriter<M> {
    /// Drafts a slot of `len` bytes for the next sample: a free one, otherwise that of the oldest
    /// sample without a lease.
    ///
    /// A sample evicted in this way is counted and lost, even if the draft is dropped.
    ///
    /// # Errors
    ///
    /// [`DraftError::TooBig`] and, if no slot is free and all samples of this ring are held,
    /// [`DraftError::NoSlot`]; both are counted. A reader holds a sample for an instant while it
    /// looks for it.
    pub fn draft(&mut self, len: usize) -> Result<Draft<M>, DraftError> {
        let drafted = self.shared.pool.draft(len).or_else(|error| match error {
            DraftError::NoSlot => self.evict(len).ok_or(error),
            DraftError::TooBig { .. } => Err(error),
        });
        let counter = match drafted {
            Ok(_) => return drafted,
            Err(DraftError::NoSlot) => &self.shared.no_slot,
            Err(DraftError::TooBig { .. }) => &self.shared.too_big,
        };
        counter.fetch_add(1, Ordering::Relaxed);
        drafted
    }

    /// Drafts the slot of the oldest sample of this ring without a lease.
    fn evict(&mut self, len: usize) -> Option<Draft<M>> {
        let ring = &*self.shared;
        for position in self.head.saturating_sub(ring.depth())..self.head {
            let place = ring.place(position);
            let index = place.load(Ordering::Relaxed);
            if index == EMPTY {
                continue;
            }
            // SAFETY: a place that is not empty stands for one hold, there is no other writer, and
            // the place is emptied as soon as that hold is gone. `Pool::draft` has checked `len`.
            if let Some(draft) = unsafe { ring.pool.reclaim(index, len) } {
                place.store(EMPTY, Ordering::Release);
                ring.count_overwritten();
                return Some(draft);
            }
        }
        None
    }

    /// Publishes a sample to the readers, and returns its position: 0, 1, 2, ...
    ///
    /// The sample `depth` positions before it leaves the ring, and is counted unless it was evicted
    /// before. Its slot returns to the pool with the last lease on it. Fails if the draft is of
    /// another pool.
    pub fn publish(&mut self, draft: Draft<M>, meta: M) -> Result<u64, ForeignDraft<M>> {
        let ring = &*self.shared;
        if !ring.pool.owns(&draft) {
            return Err(ForeignDraft(draft));
        }
        let position = self.head;
        let stamp = RingStamp { ring: ring.id, position };
        let index = draft.sealed(Some(stamp), meta).1;
        // The spare place: its last sample left when `position - 1` was published. Release pairs
        // with `at`: a reader that looks for that sample and finds this one also sees the `head` of
        // that time.
        ring.place(position).store(index, Ordering::Release);
        self.head = position + 1;
        ring.head.store(self.head, Ordering::Release);
        if let Some(leaving) = position.checked_sub(ring.depth()) {
            // Release pairs with `at`: a reader that finds the place empty also sees the current
            // `head`.
            let index = ring.place(leaving).swap(EMPTY, Ordering::Release);
            if index != EMPTY {
                // SAFETY: the place stood for one hold, and has just been emptied.
                unsafe { ring.pool.release(index) };
                ring.count_overwritten();
            }
        }
        Ok(position)
    }
}

impl<M> fmt::Debug for RingWriter<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RingWriter")
            .field("depth", &self.shared.depth())
            .field("head", &self.head)
            .finish_non_exhaustive()
    }
}
