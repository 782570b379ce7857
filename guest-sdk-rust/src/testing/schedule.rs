//! When a lambda runs: for each new sample of one input, or every so often. As in a replay of the host.

use std::sync::Arc;

use super::data::{Source, Tick};
use super::ring::Cell;

/// A longer gap between two messages is counted as missed.
const CATCH_UP_TICKS: u64 = 100_000;

pub(super) enum Schedule {
    /// Messages wait for the lambda, so that `latest` and `each` are the same here.
    Event { source: Arc<Source>, next: u64 },
    /// Counted from the first message.
    Periodic(Periodic),
}

pub(super) struct Periodic {
    period_ns: i64,
    due_ns: Option<i64>,
    missed: u64,
    missed_total: u64,
}

impl Schedule {
    /// The next wake caused by samples that have arrived.
    pub(super) fn next_event(&mut self) -> Option<(Arc<Source>, Arc<Cell>)> {
        let Self::Event { source, next } = self else { return None };
        let mut arrived = source.lock();
        while *next < arrived.ring.head {
            *next += 1;
            match arrived.ring.get(*next - 1) {
                Some(cell) => return Some((Arc::clone(source), cell)),
                None => arrived.skipped += 1,
            }
        }
        None
    }

    /// The next wake that is due before `now_ns`; call again until there is none.
    pub(super) fn next_tick(&mut self, now_ns: i64) -> Option<Tick> {
        match self {
            Self::Event { .. } => None,
            Self::Periodic(periodic) => periodic.next(now_ns),
        }
    }

    pub(super) fn missed(&self) -> u64 {
        match self {
            Self::Event { .. } => 0,
            Self::Periodic(periodic) => periodic.missed_total,
        }
    }
}

impl Periodic {
    pub(super) fn new(period_ns: i64) -> Self {
        Self { period_ns, due_ns: None, missed: 0, missed_total: 0 }
    }

    fn next(&mut self, now_ns: i64) -> Option<Tick> {
        let Some(due_ns) = self.due_ns else {
            self.due_ns = Some(now_ns.saturating_add(self.period_ns));
            return None;
        };
        // Strictly before: a tick sees all samples of its own instant.
        if due_ns >= now_ns {
            return None;
        }
        let behind = (now_ns.abs_diff(due_ns) - 1) / self.period_ns as u64 + 1;
        if behind > CATCH_UP_TICKS {
            self.missed += behind;
            self.missed_total += behind;
            // In step with the ticks before; the next one is due at `now_ns` or later.
            let passed = i64::try_from(behind).unwrap_or(i64::MAX).saturating_mul(self.period_ns);
            self.due_ns = Some(due_ns.saturating_add(passed));
            return None;
        }
        self.due_ns = Some(due_ns.saturating_add(self.period_ns));
        Some(Tick { at_ns: due_ns, missed: std::mem::take(&mut self.missed) })
    }
}
