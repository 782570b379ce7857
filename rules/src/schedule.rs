//! The schedule of a lambda: on new samples of one input, or periodic.
//!
//! A schedule only reads rings and times; it never runs anything, and it counts skipped samples and
//! missed ticks.

/// Maximum number of ticks that run in one gap between two samples. Those of a longer gap (a clock
/// that jumped, two drives far apart) are missed, so that a bad stamp cannot keep a replay busy for
/// years.
const CATCH_UP_TICKS: u64 = 100_000;

/// A ring of one input, as a schedule reads it.
pub trait RingView {
    type Sample;

    /// Returns the number of samples that entered so far, which is the position of the next one.
    fn head(&self) -> u64;
    /// Returns the maximum number of samples that the lambda sees.
    fn depth(&self) -> usize;
    /// Returns the sample at a position, if it is still in the ring.
    fn get(&self, position: u64) -> Option<Self::Sample>;
    /// Returns the newest sample, with its position.
    fn newest(&self) -> Option<(u64, Self::Sample)>;
    /// Counts samples that should have woken the lambda and did not.
    fn skip(&self, samples: u64);
}

/// The samples that wake a lambda after it was busy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Backlog {
    /// Each sample that is still in the ring.
    Each,
    /// The newest sample.
    Latest,
}

/// A periodic wake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// Time at which the tick was due, in nanoseconds.
    pub at_ns: i64,
    /// Number of ticks that were due since the previous wake and did not run.
    pub missed: u64,
}

#[derive(Debug)]
pub enum Schedule<R> {
    /// One wake for each sample, or for the newest one.
    Event(EventSchedule<R>),
    Periodic(PeriodicSchedule),
}

/// Wakes on new samples of one input.
#[derive(Debug)]
pub struct EventSchedule<R> {
    ring: R,
    backlog: Backlog,
    /// Position in the ring of the first sample that has not been considered.
    next: u64,
}

/// Wakes on a period, counted from the start of the drive, or of a live run.
#[derive(Debug, Default)]
pub struct PeriodicSchedule {
    period_ns: i64,
    /// Set if live: then a tick is missed if its successor is due as well.
    live: bool,
    due_ns: Option<i64>,
    missed: u64,
    missed_total: u64,
}

impl<R: RingView> Schedule<R> {
    pub fn event(ring: R, backlog: Backlog) -> Self {
        Self::Event(EventSchedule { ring, backlog, next: 0 })
    }

    /// Wakes every `period_ns`, at least 1. Time begins with [`Schedule::begin`], or else at the
    /// first call of [`Schedule::next_tick`].
    pub fn periodic(period_ns: i64) -> Self {
        let period_ns = period_ns.max(1);
        Self::Periodic(PeriodicSchedule { period_ns, ..PeriodicSchedule::default() })
    }

    /// Sets the start time of a replay: the first tick is due a period later.
    pub fn begin(&mut self, at_ns: i64) {
        if let Self::Periodic(periodic) = self {
            periodic.due_ns = Some(at_ns.saturating_add(periodic.period_ns));
        }
    }

    /// Sets the start time of a live run.
    pub fn begin_live(&mut self, now_ns: i64) {
        self.begin(now_ns);
        if let Self::Periodic(periodic) = self {
            periodic.live = true;
        }
    }

    /// Returns the due time of the next tick; `None` without ticks.
    pub fn next_due(&self) -> Option<i64> {
        match self {
            Self::Event(_) => None,
            Self::Periodic(periodic) => periodic.due_ns,
        }
    }

    /// Returns the next received sample that wakes the lambda.
    pub fn next_event(&mut self) -> Option<R::Sample> {
        match self {
            Self::Event(event) => event.next(),
            Self::Periodic(_) => None,
        }
    }

    /// Returns the next tick that is due before `now_ns`, or, if live, by then. Call it until it
    /// returns `None`.
    pub fn next_tick(&mut self, now_ns: i64) -> Option<Tick> {
        match self {
            Self::Event(_) => None,
            Self::Periodic(periodic) => periodic.next(now_ns),
        }
    }

    /// Counts the received samples that have not woken the lambda as skipped, at the end of a run.
    pub fn finish(&mut self) {
        if let Self::Event(event) = self {
            let head = event.ring.head();
            event.ring.skip(head - event.next.min(head));
            event.next = head;
        }
    }

    pub fn missed(&self) -> u64 {
        match self {
            Self::Event(_) => 0,
            Self::Periodic(periodic) => periodic.missed_total,
        }
    }
}

impl<R: RingView> EventSchedule<R> {
    fn next(&mut self) -> Option<R::Sample> {
        let ring = &self.ring;
        let head = ring.head();
        if self.next >= head {
            return None;
        }
        let found = match self.backlog {
            Backlog::Each => {
                // Samples that left the ring before this schedule reached them cannot wake the
                // lambda.
                let oldest = head.saturating_sub(ring.depth() as u64).max(self.next);
                (oldest..head).find_map(|position| Some((position, ring.get(position)?)))
            }
            Backlog::Latest => ring.newest(),
        };
        // While the newest sample is being replaced, a reader may find an older one, which must not
        // wake the lambda again.
        let Some((position, sample)) = found.filter(|(position, _)| *position >= self.next) else {
            ring.skip(head - self.next);
            self.next = head;
            return None;
        };
        ring.skip(position.saturating_sub(self.next));
        self.next = position + 1;
        Some(sample)
    }
}

impl PeriodicSchedule {
    fn next(&mut self, now_ns: i64) -> Option<Tick> {
        let Some(due_ns) = self.due_ns else {
            self.due_ns = Some(now_ns.saturating_add(self.period_ns));
            return None;
        };
        if self.live {
            return self.newest_due(due_ns, now_ns);
        }
        // Strictly before: a tick sees all samples of its own instant.
        if due_ns >= now_ns {
            return None;
        }
        let behind = (now_ns.abs_diff(due_ns) - 1) / self.period_ns as u64 + 1;
        if behind > CATCH_UP_TICKS {
            self.missed += behind;
            self.missed_total += behind;
            // Keeps the phase of the earlier ticks; the next one is due at `now_ns` or later.
            self.due_ns = Some(self.later(due_ns, behind));
            return None;
        }
        self.due_ns = Some(due_ns.saturating_add(self.period_ns));
        Some(Tick { at_ns: due_ns, missed: std::mem::take(&mut self.missed) })
    }

    fn newest_due(&mut self, due_ns: i64, now_ns: i64) -> Option<Tick> {
        if due_ns > now_ns {
            return None;
        }
        let missed = now_ns.abs_diff(due_ns) / self.period_ns as u64;
        self.missed_total += missed;
        let at_ns = self.later(due_ns, missed);
        self.due_ns = Some(at_ns.saturating_add(self.period_ns));
        Some(Tick { at_ns, missed })
    }

    fn later(&self, at_ns: i64, periods: u64) -> i64 {
        at_ns.saturating_add(
            i64::try_from(periods).unwrap_or(i64::MAX).saturating_mul(self.period_ns),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    struct EmptyRing;

    impl RingView for EmptyRing {
        type Sample = ();

        fn head(&self) -> u64 {
            0
        }

        fn depth(&self) -> usize {
            1
        }

        fn get(&self, _: u64) -> Option<()> {
            None
        }

        fn newest(&self) -> Option<(u64, ())> {
            None
        }

        fn skip(&self, _: u64) {}
    }

    #[test]
    fn a_jump_of_the_clock_counts_missed_ticks_instead_of_running_them() {
        let mut schedule = Schedule::<EmptyRing>::periodic(1);
        assert_eq!(schedule.next_tick(0), None);
        assert_eq!(schedule.next_tick(i64::MAX - 10), None);
        // Due at 1, 2, and so on up to, not including, `i64::MAX - 10`.
        let missed = i64::MAX as u64 - 11;
        assert_eq!(schedule.missed(), missed);
        assert_eq!(schedule.next_tick(i64::MAX), Some(Tick { at_ns: i64::MAX - 10, missed }));
    }
}
