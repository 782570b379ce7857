//! A ring of the newest samples of one input, in a fixed number of cells. Samples that the lambda
//! holds keep their cells, and may displace others.
//!
//! This is a simple version for one thread. The host's ring, in `host/buffers`, behaves in the same
//! way without a lock.

use std::collections::VecDeque;
use std::sync::Arc;

/// A cell with a sample. The lambda holds it while there is a second `Arc` of it.
#[derive(Debug)]
pub struct Cell<T> {
    pub sample: T,
    /// Number of samples that entered before it.
    pub position: u64,
}

/// Counts of a ring since its creation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Samples that entered.
    pub received: u64,
    /// Samples that newer ones replaced.
    pub overwritten: u64,
    /// Samples refused because every cell was held.
    pub no_slot: u64,
    /// Samples refused because they are larger than a cell.
    pub too_big: u64,
}

/// A ring that shows `depth` samples, with `depth + hold + 1` cells of `max_size` bytes.
#[derive(Debug)]
pub struct Ring<T> {
    depth: usize,
    cells: usize,
    max_size: usize,
    counts: Counts,
    /// Shown cells, in the order of their positions.
    shown: VecDeque<Arc<Cell<T>>>,
    /// Cells that are held, but no longer shown.
    hidden: Vec<Arc<Cell<T>>>,
}

fn is_held<T>(cell: &Arc<Cell<T>>) -> bool {
    Arc::strong_count(cell) > 1
}

impl<T> Ring<T> {
    pub fn new(depth: usize, hold: usize, max_size: usize) -> Self {
        let (counts, shown, hidden) = Default::default();
        Self { depth, cells: depth + hold + 1, max_size, counts, shown, hidden }
    }

    /// Adds a sample of `bytes`, or counts the reason why it is refused.
    pub fn push(&mut self, sample: T, bytes: usize) {
        if bytes > self.max_size {
            self.counts.too_big += 1;
            return;
        }
        self.hidden.retain(is_held);
        if self.shown.len() + self.hidden.len() >= self.cells && !self.evict() {
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
                self.hidden.push(cell);
            }
        }
    }

    /// Evicts the oldest sample that is not held. Returns `false` if there is none.
    fn evict(&mut self) -> bool {
        let oldest = self.shown.iter().position(|cell| !is_held(cell));
        self.counts.overwritten += u64::from(oldest.is_some());
        oldest.is_some_and(|at| self.shown.remove(at).is_some())
    }

    /// Returns the maximum number of shown samples.
    pub fn depth(&self) -> usize {
        self.depth
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Returns the sample at a position, if it is shown.
    pub fn get(&self, position: u64) -> Option<Arc<Cell<T>>> {
        self.shown.iter().find(|cell| cell.position == position).cloned()
    }

    pub fn newest(&self) -> Option<Arc<Cell<T>>> {
        self.shown.back().cloned()
    }

    /// Returns the newest samples back to the first one that `keep` refuses, at most `most`; oldest
    /// first.
    pub fn newest_while(&self, most: usize, keep: impl Fn(&T) -> bool) -> Vec<Arc<Cell<T>>> {
        let newest = self.shown.iter().rev().take(most).take_while(|cell| keep(&cell.sample));
        let mut found = newest.cloned().collect::<Vec<_>>();
        found.reverse();
        found
    }
}
