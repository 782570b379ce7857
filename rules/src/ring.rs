//! The newest samples of one input, within a number of cells: what the lambda holds stays, and may
//! cost others their place.
//!
//! This is what a ring shows, said plainly and for one thread. The host's ring, in `host/buffers`,
//! shows the same without a lock.

use std::collections::VecDeque;
use std::sync::Arc;

/// One sample in its place. Whoever has a second `Arc` of it holds it.
#[derive(Debug)]
pub struct Cell<T> {
    /// The sample.
    pub sample: T,
    /// How many entered before it.
    pub position: u64,
}

/// What a ring has received and lost since it was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Samples that entered.
    pub received: u64,
    /// Samples that left, to make room for newer ones.
    pub overwritten: u64,
    /// Samples refused because every cell was held.
    pub no_slot: u64,
    /// Samples refused because they are larger than a cell.
    pub too_big: u64,
}

/// Shows `depth` samples, over `depth + hold + 1` cells of `max_size` bytes.
#[derive(Debug)]
pub struct Ring<T> {
    depth: usize,
    cells: usize,
    max_size: usize,
    counts: Counts,
    /// In the order of their positions.
    shown: VecDeque<Arc<Cell<T>>>,
    /// No longer shown, and held.
    left: Vec<Arc<Cell<T>>>,
}

fn is_held<T>(cell: &Arc<Cell<T>>) -> bool {
    Arc::strong_count(cell) > 1
}

impl<T> Ring<T> {
    /// A ring of which nothing has arrived yet.
    pub fn new(depth: usize, hold: usize, max_size: usize) -> Self {
        let (counts, shown, left) = Default::default();
        Self { depth, cells: depth + hold + 1, max_size, counts, shown, left }
    }

    /// Takes a sample of `bytes` in, or counts why not.
    pub fn push(&mut self, sample: T, bytes: usize) {
        if bytes > self.max_size {
            self.counts.too_big += 1;
            return;
        }
        self.left.retain(is_held);
        if self.shown.len() + self.left.len() >= self.cells && !self.evict() {
            self.counts.no_slot += 1;
            return;
        }
        let position = self.counts.received;
        self.shown.push_back(Arc::new(Cell { sample, position }));
        self.counts.received += 1;
        let leaves = |cell: &Arc<Cell<T>>| cell.position + self.depth as u64 == position;
        let leaving =
            if self.shown.front().is_some_and(leaves) { self.shown.pop_front() } else { None };
        if let Some(cell) = leaving {
            self.counts.overwritten += 1;
            if is_held(&cell) {
                self.left.push(cell);
            }
        }
    }

    /// Lets the oldest sample go that nobody holds.
    fn evict(&mut self) -> bool {
        let oldest = self.shown.iter().position(|cell| !is_held(cell));
        self.counts.overwritten += u64::from(oldest.is_some());
        oldest.is_some_and(|at| self.shown.remove(at).is_some())
    }

    /// How many samples are shown at most.
    pub fn depth(&self) -> usize {
        self.depth
    }

    /// What became of the samples.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// The sample at a position, if it is shown.
    pub fn get(&self, position: u64) -> Option<Arc<Cell<T>>> {
        self.shown.iter().find(|cell| cell.position == position).cloned()
    }

    /// The newest sample that is shown.
    pub fn newest(&self) -> Option<Arc<Cell<T>>> {
        self.shown.back().cloned()
    }

    /// The newest samples back to the first one that `keep` refuses, `most` at most; oldest first.
    pub fn newest_while(&self, most: usize, keep: impl Fn(&T) -> bool) -> Vec<Arc<Cell<T>>> {
        let newest = self.shown.iter().rev().take(most).take_while(|cell| keep(&cell.sample));
        let mut found = newest.cloned().collect::<Vec<_>>();
        found.reverse();
        found
    }
}
