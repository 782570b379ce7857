//! The set of free slots, with one bit for each.
//!
//! A bit means "free now", whatever happened to the slot before: unlike a linked free list, it is
//! immune to ABA. A scan of 512 slots is 8 loads.

use crate::sync::{AtomicU64, Ordering};

pub(crate) struct FreeSet {
    words: Box<[AtomicU64]>,
}

impl FreeSet {
    /// Creates the set of all of 0..`slots`.
    pub(crate) fn full(slots: u32) -> Self {
        let word = |first| match slots - first {
            64.. => u64::MAX,
            rest => (1 << rest) - 1,
        };
        Self { words: (0..slots).step_by(64).map(|first| AtomicU64::new(word(first))).collect() }
    }

    /// Takes the lowest free slot that it sees. All accesses before its [`give`](Self::give) are
    /// visible.
    ///
    /// May return `None` although a slot is free, if other threads take and give at the same time.
    pub(crate) fn take(&self) -> Option<u32> {
        for (word, first) in self.words.iter().zip((0..).step_by(64)) {
            let mut seen = word.load(Ordering::Relaxed);
            while seen != 0 {
                let bit = seen.trailing_zeros();
                // Acquire pairs with `give`. All changes are read-modify-writes, so each `give`
                // before this one is in the release sequence that it reads from.
                seen = word.fetch_and(!(1 << bit), Ordering::Acquire);
                if seen & (1 << bit) != 0 {
                    return Some(first + bit);
                }
            }
        }
        None
    }

    /// Returns a slot that [`take`](Self::take) took.
    pub(crate) fn give(&self, index: u32) {
        let before = self.words[index as usize / 64].fetch_or(1 << (index % 64), Ordering::Release);
        debug_assert_eq!(before & (1 << (index % 64)), 0, "slot {index} freed twice");
    }

    pub(crate) fn count(&self) -> usize {
        let ones = |word: &AtomicU64| word.load(Ordering::Relaxed).count_ones() as usize;
        self.words.iter().map(ones).sum()
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;

    #[test]
    fn every_slot_is_taken_once() {
        for slots in [1, 63, 64, 65, 128, 130] {
            let free = FreeSet::full(slots);
            assert_eq!(free.count(), slots as usize);
            let taken: Vec<u32> = std::iter::from_fn(|| free.take()).collect();
            assert_eq!(taken, (0..slots).collect::<Vec<_>>());
            assert_eq!(free.count(), 0);
        }
    }

    #[test]
    fn a_returned_slot_is_taken_again() {
        let free = FreeSet::full(70);
        while free.take().is_some() {}
        free.give(66);
        assert_eq!((free.count(), free.take(), free.take()), (1, Some(66), None));
    }
}
