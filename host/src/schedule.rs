//! When a lambda runs: for each new sample of one input, or every so often.
//!
//! A schedule only looks at rings and times; it never runs anything, and it counts what it passes over.

use std::sync::Arc;
use std::time::Duration;

use gleaner_lambda::manifest::{Backlog, Manifest, Schedule as Declared};

use crate::api::data::{Tick, Topic, Wake};

/// Ticks made up for in one gap between two samples. A longer gap (a clock that jumped, two drives far apart) is counted as
/// missed, so that a bad stamp cannot keep a replay busy for years.
const CATCH_UP_TICKS: u64 = 100_000;

/// The schedule of one lambda.
pub enum Schedule {
    /// One wake for each sample, or for the newest one.
    Event(Event),
    /// One wake for each period.
    Periodic(Periodic),
}

/// Wakes on new samples of one topic.
pub struct Event {
    topic: Arc<Topic>,
    backlog: Backlog,
    /// Position in the ring of the first sample that has not been considered.
    next: u64,
}

/// Wakes on a period, counted from the start of the drive, or live of the run.
pub struct Periodic {
    period_ns: i64,
    /// Live, a tick whose successor is due as well is missed: nobody waits for what is late.
    live: bool,
    due_ns: Option<i64>,
    missed: u64,
    missed_total: u64,
}

impl Schedule {
    /// The schedule that `manifest` declares, over its inputs in the manifest's order.
    pub fn new(manifest: &Manifest, inputs: &[Arc<Topic>]) -> Self {
        match &manifest.schedule {
            Declared::Event { input, backlog } => {
                let topic =
                    inputs.iter().find(|topic| topic.name() == input.as_str()).expect("the manifest was checked");
                Self::Event(Event { topic: Arc::clone(topic), backlog: *backlog, next: 0 })
            }
            Declared::Periodic { period } => Self::Periodic(Periodic::new(*period)),
        }
    }

    /// The same where time does not wait: it is `now_ns`, and the first tick comes a period later.
    pub fn live(manifest: &Manifest, inputs: &[Arc<Topic>], now_ns: i64) -> Self {
        let mut schedule = Self::new(manifest, inputs);
        if let Self::Periodic(periodic) = &mut schedule {
            periodic.live = true;
            periodic.due_ns = Some(now_ns.saturating_add(periodic.period_ns));
        }
        schedule
    }

    /// Time begins, in a replay: the first tick comes a period later.
    pub fn begin(&mut self, at_ns: i64) {
        if let Self::Periodic(periodic) = self {
            periodic.due_ns = Some(at_ns.saturating_add(periodic.period_ns));
        }
    }

    /// When the next tick is due, if time causes any.
    pub fn next_due(&self) -> Option<i64> {
        match self {
            Self::Event(_) => None,
            Self::Periodic(periodic) => periodic.due_ns,
        }
    }

    /// The next wake caused by samples that have arrived.
    pub fn next_event(&mut self) -> Option<Wake> {
        match self {
            Self::Event(event) => event.next(),
            Self::Periodic(_) => None,
        }
    }

    /// The next wake that is due before `now_ns`; call again until there is none.
    pub fn next_tick(&mut self, now_ns: i64) -> Option<Wake> {
        match self {
            Self::Event(_) => None,
            Self::Periodic(periodic) => periodic.next(now_ns).map(Wake::Tick),
        }
    }

    /// At the end: what has arrived and woken nobody was skipped.
    pub fn finish(&mut self) {
        if let Self::Event(event) = self {
            let head = event.topic.reader().head();
            event.topic.add_skipped(head - event.next.min(head));
            event.next = head;
        }
    }

    /// Ticks that were due and did not happen.
    pub fn missed(&self) -> u64 {
        match self {
            Self::Event(_) => 0,
            Self::Periodic(periodic) => periodic.missed_total,
        }
    }
}

impl Event {
    fn next(&mut self) -> Option<Wake> {
        let reader = self.topic.reader();
        let head = reader.head();
        if self.next >= head {
            return None;
        }
        let lease = match self.backlog {
            Backlog::Each => {
                // What left the ring before this schedule came to it cannot wake any more.
                let oldest = head.saturating_sub(self.topic.depth() as u64).max(self.next);
                (oldest..head).find_map(|position| reader.get(position))
            }
            Backlog::Latest => reader.newest(),
        };
        // While the newest sample is being replaced, a reader may find an older one: what was judged is not judged again.
        let considered = lease.and_then(|lease| Some((lease.position()?, lease)));
        let Some((position, lease)) = considered.filter(|(position, _)| *position >= self.next) else {
            self.topic.add_skipped(head - self.next);
            self.next = head;
            return None;
        };
        self.topic.add_skipped(position.saturating_sub(self.next));
        self.next = position + 1;
        Some(Wake::Event(self.topic.sample(lease)))
    }
}

impl Periodic {
    fn new(period: Duration) -> Self {
        let period_ns = i64::try_from(period.as_nanos()).unwrap_or(i64::MAX).max(1);
        Self { period_ns, live: false, due_ns: None, missed: 0, missed_total: 0 }
    }

    fn next(&mut self, now_ns: i64) -> Option<Tick> {
        if let (true, Some(due_ns)) = (self.live, self.due_ns) {
            return self.newest_due(due_ns, now_ns);
        }
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

    /// The newest of the ticks that are due by now.
    fn newest_due(&mut self, due_ns: i64, now_ns: i64) -> Option<Tick> {
        if due_ns > now_ns {
            return None;
        }
        let missed = now_ns.abs_diff(due_ns) / self.period_ns as u64;
        self.missed_total += missed;
        let passed = i64::try_from(missed).unwrap_or(i64::MAX).saturating_mul(self.period_ns);
        let at_ns = due_ns.saturating_add(passed);
        self.due_ns = Some(at_ns.saturating_add(self.period_ns));
        Some(Tick { at_ns, missed })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ticks(periodic: &mut Periodic, now_ns: i64) -> Vec<i64> {
        std::iter::from_fn(|| periodic.next(now_ns)).map(|tick| tick.at_ns).collect()
    }

    #[test]
    fn ticks_come_before_the_sample_that_is_later_and_after_the_one_of_the_same_instant() {
        let mut periodic = Periodic::new(Duration::from_nanos(100));
        assert!(ticks(&mut periodic, 1000).is_empty());
        assert!(ticks(&mut periodic, 1100).is_empty());
        assert_eq!(ticks(&mut periodic, 1350), [1100, 1200, 1300]);
    }

    #[test]
    fn a_jump_of_the_clock_counts_missed_ticks_instead_of_running_them() {
        let mut periodic = Periodic::new(Duration::from_nanos(1));
        assert!(ticks(&mut periodic, 0).is_empty());
        assert!(ticks(&mut periodic, i64::MAX - 10).is_empty());
        // Due at 1, 2, and so on up to, not including, `i64::MAX - 10`.
        assert_eq!(periodic.missed_total, i64::MAX as u64 - 11);
        let tick = periodic.next(i64::MAX).unwrap();
        assert_eq!((tick.at_ns, tick.missed), (i64::MAX - 10, periodic.missed_total));
    }

    #[test]
    fn missed_ticks_are_those_before_now_and_no_more() {
        let mut periodic = Periodic::new(Duration::from_nanos(100));
        assert!(ticks(&mut periodic, 1000).is_empty());
        // Due at 1100, 1200, ..., 20,001,100.
        assert!(ticks(&mut periodic, 20_001_150).is_empty());
        assert_eq!(periodic.missed_total, 200_001);
    }

    #[test]
    fn live_only_the_newest_due_tick_runs_and_the_others_are_missed() {
        let mut periodic = Periodic { live: true, due_ns: Some(1100), ..Periodic::new(Duration::from_nanos(100)) };
        assert_eq!(periodic.next(1099), None);
        assert_eq!(periodic.next(1100), Some(Tick { at_ns: 1100, missed: 0 }));
        assert_eq!(periodic.next(1510), Some(Tick { at_ns: 1500, missed: 3 }));
        assert_eq!(periodic.next(1511), None);
        assert_eq!(periodic.next(1600), Some(Tick { at_ns: 1600, missed: 0 }));
        assert_eq!(periodic.missed_total, 3);
    }

    #[test]
    fn a_clock_that_goes_back_causes_no_tick() {
        let mut periodic = Periodic::new(Duration::from_nanos(100));
        assert!(ticks(&mut periodic, 1000).is_empty());
        assert!(ticks(&mut periodic, -5000).is_empty());
        assert_eq!(ticks(&mut periodic, 1101), [1100]);
    }
}
