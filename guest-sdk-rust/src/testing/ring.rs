//! The newest samples of one input, within a number of cells: what the lambda holds stays, and may cost others their place.

use std::collections::VecDeque;
use std::sync::Arc;

use super::message::Message;
use super::types::Guid;

/// One message, on its way into a ring.
pub(crate) struct Arrival {
    pub(super) at_ns: i64,
    pub(super) publish_ns: i64,
    pub(super) writer: Guid,
    pub(super) seq: u64,
    pub(super) message: Message,
}

/// One sample in its place. Whoever has a second `Arc` of it holds it.
pub(crate) struct Cell {
    pub(super) arrival: Arrival,
    pub(super) position: u64,
}

/// Shows `depth` samples, over `depth + hold + 1` cells.
pub(super) struct Ring {
    depth: usize,
    cells: usize,
    pub(super) head: u64,
    pub(super) overwritten: u64,
    pub(super) no_slot: u64,
    pub(super) too_big: u64,
    /// In the order of their positions.
    shown: VecDeque<Arc<Cell>>,
    /// No longer shown, and held.
    left: Vec<Arc<Cell>>,
}

fn is_held(cell: &Arc<Cell>) -> bool {
    Arc::strong_count(cell) > 1
}

impl Ring {
    pub(super) fn new(depth: usize, hold: usize) -> Self {
        let (shown, left) = Default::default();
        Self { depth, cells: depth + hold + 1, head: 0, overwritten: 0, no_slot: 0, too_big: 0, shown, left }
    }

    /// Takes a sample in, or counts that there is no cell for it.
    pub(super) fn push(&mut self, arrival: Arrival) {
        self.left.retain(is_held);
        if self.shown.len() + self.left.len() >= self.cells && !self.evict() {
            self.no_slot += 1;
            return;
        }
        self.shown.push_back(Arc::new(Cell { arrival, position: self.head }));
        let leaves = |cell: &Arc<Cell>| cell.position + self.depth as u64 == self.head;
        let leaving = if self.shown.front().is_some_and(leaves) { self.shown.pop_front() } else { None };
        self.head += 1;
        if let Some(cell) = leaving {
            self.overwritten += 1;
            if is_held(&cell) {
                self.left.push(cell);
            }
        }
    }

    /// Lets the oldest sample go that nobody holds.
    fn evict(&mut self) -> bool {
        let oldest = self.shown.iter().position(|cell| !is_held(cell));
        self.overwritten += u64::from(oldest.is_some());
        oldest.is_some_and(|at| self.shown.remove(at).is_some())
    }

    /// The sample at a position, if it is shown.
    pub(super) fn get(&self, position: u64) -> Option<Arc<Cell>> {
        self.shown.iter().find(|cell| cell.position == position).cloned()
    }

    pub(super) fn newest(&self) -> Option<Arc<Cell>> {
        self.shown.back().cloned()
    }

    /// The newest samples back to the first one that `keep` refuses, `most` at most; oldest first.
    pub(super) fn newest_while(&self, most: usize, keep: impl Fn(&Arrival) -> bool) -> Vec<Arc<Cell>> {
        let newest = self.shown.iter().rev().take(most).take_while(|cell| keep(&cell.arrival));
        let mut found = newest.cloned().collect::<Vec<_>>();
        found.reverse();
        found
    }
}
