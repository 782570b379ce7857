//! Counts of what bounds have ended and refused, as the log shows them.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use gleaner_base::RateLimit;

/// Lines of the log about a bound: one in a minute, with all numbers so far.
const LINES: RateLimit = RateLimit::of(1.0 / 60.0, 1.0);

/// The numbers of connections or streams that a bound has ended and refused, since the start.
#[derive(Debug)]
pub struct BoundCounts {
    things: &'static str,
    state: Mutex<CountedEnds>,
}

#[derive(Debug)]
struct CountedEnds {
    ended: u64,
    refused: u64,
    lines: RateLimit,
}

impl BoundCounts {
    /// Creates counts of connections or streams with the name `things` in the log.
    pub const fn of(things: &'static str) -> Self {
        let state = Mutex::new(CountedEnds { ended: 0, refused: 0, lines: LINES });
        Self { things, state }
    }

    /// Counts one that has ended for another one.
    pub fn ended(&self) {
        let mut state = self.lock();
        state.ended += 1;
        self.log(state);
    }

    /// Counts one that was refused.
    pub fn refused(&self) {
        let mut state = self.lock();
        state.refused += 1;
        self.log(state);
    }

    fn log(&self, mut state: MutexGuard<'_, CountedEnds>) {
        if !state.lines.take(1.0, Instant::now()) {
            return;
        }
        let (things, ended, refused) = (self.things, state.ended, state.refused);
        drop(state);
        tracing::warn!(
            things,
            ended,
            refused,
            "limit of connections or streams hit, numbers since the start"
        );
    }

    fn lock(&self) -> MutexGuard<'_, CountedEnds> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns how many have ended for another one, and how many were refused.
    pub fn numbers(&self) -> (u64, u64) {
        let state = self.lock();
        (state.ended, state.refused)
    }
}
