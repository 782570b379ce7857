//! A topic in shared memory as a ring: positions from 0, and metadata of one type.

use super::{HeldSample, META_WORDS, ReadError, SharedReader};
use crate::sync::{AtomicU64, Ordering};
use crate::{Lease, RingCounts};

/// The newest samples of a topic from a first position on.
pub(crate) struct SharedRing<M> {
    reader: SharedReader,
    first: u64,
    depth: u64,
    decode: fn(&[u64; META_WORDS]) -> M,
    too_big: fn(&SharedReader) -> u64,
    /// Samples that were too large before the ring was opened.
    too_big_before: u64,
    refused_holds: AtomicU64,
}

impl<M> SharedRing<M> {
    pub(crate) fn new(
        reader: SharedReader,
        first: u64,
        depth: usize,
        decode: fn(&[u64; META_WORDS]) -> M,
        too_big: fn(&SharedReader) -> u64,
    ) -> Self {
        Self {
            depth: (depth as u64).min(reader.depth().into()),
            too_big_before: too_big(&reader),
            reader,
            first,
            decode,
            too_big,
            refused_holds: AtomicU64::new(0),
        }
    }

    pub(crate) fn head(&self) -> u64 {
        self.reader.head().saturating_sub(self.first)
    }

    pub(crate) fn depth(&self) -> u64 {
        self.depth
    }

    /// Returns the sample at a position of the newest `depth`.
    pub(crate) fn at(&self, position: u64) -> Option<Lease<M>> {
        self.held(self.reader.get(self.first.checked_add(position)?)).map(|held| self.lease(held))
    }

    pub(crate) fn meta(&self, position: u64) -> Option<M> {
        let is_newest = self.head().checked_sub(position)? <= self.depth;
        let words = is_newest.then(|| self.reader.meta(self.first.checked_add(position)?))?;
        words.map(|words| (self.decode)(&words))
    }

    pub(crate) fn newest_meta(&self) -> Option<(u64, M)> {
        let (position, words) = self.reader.newest_meta()?;
        Some((position.checked_sub(self.first)?, (self.decode)(&words)))
    }

    pub(crate) fn newest_before(&self, end: u64) -> Option<Lease<M>> {
        let mut newest = None;
        self.newest_while_into(end, 1, |_| true, |lease| newest = Some(lease));
        newest
    }

    pub(crate) fn newest_while(
        &self,
        end: u64,
        max: usize,
        keep: impl FnMut(&M) -> bool,
        out: &mut Vec<Lease<M>>,
    ) {
        self.newest_while_into(end, max, keep, |lease| out.push(lease));
    }

    fn newest_while_into(
        &self,
        end: u64,
        max: usize,
        mut keep: impl FnMut(&M) -> bool,
        take: impl FnMut(Lease<M>),
    ) {
        // The topic may show more than `depth`, also from before the first position.
        let head = self.head();
        let oldest = head.saturating_sub(self.depth);
        let shown = end.min(head).saturating_sub(oldest);
        let max = u32::try_from(shown.min(max as u64)).unwrap_or(u32::MAX);
        let end = self.first.saturating_add(end);
        let keep = |words: &[u64; META_WORDS]| keep(&(self.decode)(words));
        let window = self.held(self.reader.newest_while(end, max, keep));
        let samples = window.map(|window| window.into_samples()).unwrap_or_default();
        samples.into_iter().map(|held| self.lease(held)).for_each(take);
    }

    pub(crate) fn counts(&self) -> RingCounts {
        let received = self.head();
        RingCounts {
            received,
            overwritten: received.saturating_sub(self.depth),
            no_slot: 0,
            too_big: (self.too_big)(&self.reader).saturating_sub(self.too_big_before),
        }
    }

    pub(crate) fn refused_holds(&self) -> u64 {
        self.refused_holds.load(Ordering::Relaxed)
    }

    fn lease(&self, held: HeldSample) -> Lease<M> {
        let (position, meta) = (held.position() - self.first, (self.decode)(held.meta()));
        Lease::shared(held, position, meta)
    }

    /// Counts a refused hold.
    fn held<T>(&self, held: Result<Option<T>, ReadError>) -> Option<T> {
        held.unwrap_or_else(|_| {
            self.refused_holds.fetch_add(1, Ordering::Relaxed);
            None
        })
    }
}
