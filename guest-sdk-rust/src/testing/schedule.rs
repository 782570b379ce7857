//! Schedules the wakes of a run, by `gleaner_rules::schedule` over its rings.

use std::sync::Arc;

use gleaner_rules::schedule::{self as rules, RingView};

use super::data::InputState;
use super::ring::Cell;

pub(super) type Schedule = rules::Schedule<EventInput>;

/// The input whose messages wake the lambda. Each message waits until the lambda is free, so the
/// backlogs `latest` and `each` are the same here.
pub(super) struct EventInput(pub(super) Arc<InputState>);

impl RingView for EventInput {
    type Sample = (Arc<InputState>, Arc<Cell>);

    fn head(&self) -> u64 {
        self.0.lock().ring.counts().received
    }

    fn depth(&self) -> usize {
        self.0.declared.depth
    }

    fn get(&self, position: u64) -> Option<Self::Sample> {
        self.0.lock().ring.get(position).map(|cell| (Arc::clone(&self.0), cell))
    }

    fn newest(&self) -> Option<(u64, Self::Sample)> {
        self.0.lock().ring.newest().map(|cell| (cell.position, (Arc::clone(&self.0), cell)))
    }

    fn skip(&self, samples: u64) {
        self.0.lock().skipped += samples;
    }
}
