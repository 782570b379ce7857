//! A topic in shared memory as a ring: positions from 0, and metadata of one type.
//!
//! The ring continues in other memory when another process takes over the topic: the samples in the
//! earlier memory stay in the ring until newer ones replace them.

use std::ops::ControlFlow;
use std::sync::{Arc, PoisonError, RwLock};

use super::{HeldSample, META_WORDS, ReadError, SharedReader};
use crate::sync::{AtomicU64, Ordering};
use crate::{Lease, RingCounts};

/// Most memories of one ring: a topic whose writer restarts again and again keeps no more.
const PARTS: usize = 8;

/// The newest samples of a topic from a first position on.
pub(crate) struct SharedRing<M> {
    depth: u64,
    too_big: fn(&SharedReader) -> u64,
    /// The current memory, then earlier ones that may still have samples of the ring.
    parts: RwLock<Arc<[Arc<RingPart<M>>]>>,
    refused_holds: AtomicU64,
}

type Decode<M> = Box<dyn Fn(&[u64; META_WORDS]) -> M + Send + Sync>;

/// Samples of the ring in one memory.
struct RingPart<M> {
    reader: SharedReader,
    /// Position in the memory of the first sample.
    first: u64,
    /// Its position in the ring.
    base: u64,
    decode: Decode<M>,
    /// Samples that were too large before the part began: in this memory, and in earlier parts.
    too_big_before: u64,
    too_big_earlier: u64,
}

impl<M> RingPart<M> {
    /// Position in the ring of its next sample.
    fn end(&self) -> u64 {
        self.base.saturating_add(self.reader.head().saturating_sub(self.first))
    }

    /// Position in the memory of a position in the ring.
    fn inner(&self, position: u64) -> Option<u64> {
        self.first.checked_add(position.checked_sub(self.base)?)
    }

    /// Position in the ring of a sample of its memory.
    fn position(&self, held: &HeldSample) -> u64 {
        self.base + (held.position() - self.first)
    }

    fn lease(&self, held: HeldSample) -> Lease<M> {
        let position = self.position(&held);
        let meta = (self.decode)(held.meta());
        Lease::shared(held, position, meta)
    }
}

impl<M> SharedRing<M> {
    pub(crate) fn new(
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
        let depth = (depth as u64).min(reader.depth().into());
        let (base, too_big_earlier) = (0, 0);
        let decode = Box::new(decode);
        let part = RingPart { reader, first, base, decode, too_big_before, too_big_earlier };
        let parts = RwLock::new([Arc::new(part)].into());
        Self { depth, too_big, parts, refused_holds: AtomicU64::new(0) }
    }

    /// Continues the ring from position `first` of `reader` on. Nothing writes to the earlier
    /// memory any more.
    pub(crate) fn continue_in(
        &self,
        reader: SharedReader,
        first: u64,
        too_big_before: u64,
        decode: Decode<M>,
    ) {
        let mut parts = self.parts.write().unwrap_or_else(PoisonError::into_inner);
        let Some(current) = parts.first() else { return };
        let base = current.end();
        let too_big_earlier = self.too_big_of(current);
        let part = RingPart { reader, first, base, decode, too_big_before, too_big_earlier };
        let mut end = base;
        let earlier = parts.iter().filter(|earlier| {
            let is_shown = earlier.base < end && base - end < self.depth;
            end = earlier.base;
            is_shown
        });
        let all: Vec<_> = [Arc::new(part)].into_iter().chain(earlier.cloned()).collect();
        *parts = all.into_iter().take(PARTS).collect();
    }

    /// Drops earlier memory whose samples have all left the ring.
    pub(crate) fn drop_left(&self) {
        let oldest = self.head().saturating_sub(self.depth);
        let is_left = |parts: &[Arc<RingPart<M>>]| {
            parts.iter().rev().nth(1).is_some_and(|newer| newer.base <= oldest)
        };
        if !is_left(&self.parts()) {
            return;
        }
        let mut parts = self.parts.write().unwrap_or_else(PoisonError::into_inner);
        let mut shown = parts.to_vec();
        while is_left(&shown) {
            shown.pop();
        }
        *parts = shown.into();
    }

    pub(crate) fn head(&self) -> u64 {
        self.parts().first().map_or(0, |current| current.end())
    }

    pub(crate) fn depth(&self) -> u64 {
        self.depth
    }

    /// Returns the sample at a position of the newest `depth`.
    pub(crate) fn at(&self, position: u64) -> Option<Lease<M>> {
        let parts = self.parts();
        let (part, inner) = Self::find(&parts, position)?;
        self.held(part.reader.get(inner)).map(|held| part.lease(held))
    }

    pub(crate) fn meta(&self, position: u64) -> Option<M> {
        let parts = self.parts();
        let is_newest = parts.first()?.end().checked_sub(position)? <= self.depth;
        let (part, inner) = Self::find(&parts, position).filter(|_| is_newest)?;
        part.reader.meta(inner).map(|words| (part.decode)(&words))
    }

    pub(crate) fn newest_meta(&self) -> Option<(u64, M)> {
        self.parts().iter().find_map(|part| {
            let (inner, words) = part.reader.newest_meta()?;
            let position = part.base + inner.checked_sub(part.first)?;
            Some((position, (part.decode)(&words)))
        })
    }

    pub(crate) fn newest_before(&self, end: u64) -> Option<Lease<M>> {
        let parts = self.parts();
        let mut newest = None;
        self.newest_of_all(
            &parts,
            end,
            1,
            |_| true,
            |part, samples| {
                newest = samples.into_iter().next().map(|held| part.lease(held));
                ControlFlow::Continue(())
            },
        );
        newest
    }

    pub(crate) fn newest_while(
        &self,
        end: u64,
        max: usize,
        keep: impl FnMut(&M) -> bool,
        out: &mut Vec<Lease<M>>,
    ) {
        let parts = self.parts();
        let mut found = Vec::new();
        self.newest_of_all(&parts, end, max, keep, |part, samples| {
            found.push((part, samples));
            ControlFlow::Continue(())
        });
        for (part, samples) in found.into_iter().rev() {
            out.extend(samples.into_iter().map(|held| part.lease(held)));
        }
    }

    /// As [`RingReader::visit_while_before`](crate::RingReader::visit_while_before).
    pub(crate) fn visit_while(
        &self,
        end: u64,
        max: usize,
        keep: impl FnMut(&M) -> bool,
        mut visit: impl FnMut(u64, &M, &[u8]) -> ControlFlow<()>,
    ) {
        let parts = self.parts();
        self.newest_of_all(&parts, end, max, keep, |part, samples| {
            samples.iter().rev().try_for_each(|held| {
                let meta = (part.decode)(held.meta());
                visit(part.position(held), &meta, held)
            })
        });
    }

    /// Holds the newest samples below `end`, at most `max`, back to the first one that `keep`
    /// refuses, and passes them to `found` part by part until it breaks: the newest part first, the
    /// oldest sample first in each.
    fn newest_of_all<'a>(
        &self,
        parts: &'a [Arc<RingPart<M>>],
        end: u64,
        max: usize,
        mut keep: impl FnMut(&M) -> bool,
        mut found: impl FnMut(&'a RingPart<M>, Vec<HeldSample>) -> ControlFlow<()>,
    ) {
        let Some(current) = parts.first() else { return };
        // The topic may show more than `depth`, also from before the first position.
        let head = current.end();
        let oldest = head.saturating_sub(self.depth);
        let shown = end.min(head).saturating_sub(oldest);
        let mut left = u32::try_from(shown.min(max as u64)).unwrap_or(u32::MAX);
        let mut end = end;
        for part in parts {
            let (samples, is_whole) = self.newest_of(part, end, left, &mut keep);
            left = left.saturating_sub(samples.len() as u32);
            end = end.min(part.base);
            if found(part, samples).is_break() || left == 0 || !is_whole {
                return;
            }
        }
    }

    /// Holds the newest samples of a part below `end`, as far back as `keep` wants. Also returns
    /// whether they reach back to its first one, so that those of earlier parts follow.
    fn newest_of(
        &self,
        part: &RingPart<M>,
        end: u64,
        max: u32,
        keep: &mut impl FnMut(&M) -> bool,
    ) -> (Vec<HeldSample>, bool) {
        // The memory may show samples from before the first one.
        let shown = end.min(part.end()).saturating_sub(part.base);
        if shown == 0 {
            return (Vec::new(), true);
        }
        let max = max.min(u32::try_from(shown).unwrap_or(u32::MAX));
        let inner = part.first.saturating_add(end - part.base);
        let mut is_kept = true;
        let window = part.reader.newest_while(inner, max, |words| {
            is_kept = keep(&(part.decode)(words));
            is_kept
        });
        let samples = self.held(window).map(|window| window.into_samples()).unwrap_or_default();
        let is_first = samples.first().is_some_and(|oldest| oldest.position() <= part.first);
        (samples, is_kept && is_first)
    }

    pub(crate) fn counts(&self) -> RingCounts {
        let parts = self.parts();
        let received = parts.first().map_or(0, |current| current.end());
        RingCounts {
            received,
            overwritten: received.saturating_sub(self.depth),
            no_slot: 0,
            too_big: parts.first().map_or(0, |current| self.too_big_of(current)),
        }
    }

    pub(crate) fn refused_holds(&self) -> u64 {
        self.refused_holds.load(Ordering::Relaxed)
    }

    /// Number of samples that were too large, up to the end of a part.
    fn too_big_of(&self, part: &RingPart<M>) -> u64 {
        let of_part = (self.too_big)(&part.reader).saturating_sub(part.too_big_before);
        part.too_big_earlier.saturating_add(of_part)
    }

    fn parts(&self) -> Arc<[Arc<RingPart<M>>]> {
        Arc::clone(&self.parts.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Returns the part that has a position, and the position in its memory.
    fn find(parts: &[Arc<RingPart<M>>], position: u64) -> Option<(&RingPart<M>, u64)> {
        parts.iter().find_map(|part| Some((&**part, part.inner(position)?)))
    }

    /// Counts a refused hold.
    fn held<T>(&self, held: Result<Option<T>, ReadError>) -> Option<T> {
        held.unwrap_or_else(|_| {
            self.refused_holds.fetch_add(1, Ordering::Relaxed);
            None
        })
    }
}
