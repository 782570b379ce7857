//! Detects that the time of day was set back, which RustDDS cannot cope with: it orders samples of
//! best-effort writers by the time of arrival (`src/structure/dds_cache.rs`,
//! `get_changes_in_range_best_effort`).

use gleaner_messages::transport::clock::monotonic;

/// Detects that the time of day was set back.
///
/// RustDDS orders the samples of best-effort readers by the time of day at which they arrived,
/// announcements of participants included, and shows nothing that is later than now.
#[derive(Debug)]
pub(super) struct ClockWatch {
    shown: fn() -> i64,
    /// Its lead over `CLOCK_MONOTONIC` at the last check, in ns.
    ahead_ns: Option<i64>,
}

impl ClockWatch {
    /// Smaller steps are ignored: after that time all is well again.
    const MAX_NS: i64 = 1_000_000_000;
    /// Longest time between the two readings of `CLOCK_MONOTONIC`; if it was longer, the thread was
    /// stopped in between.
    const MAX_GAP_NS: i64 = 100_000_000;

    /// `shown` returns the time of day, in ns.
    pub(super) fn new(shown: fn() -> i64) -> Self {
        Self { shown, ahead_ns: None }
    }

    /// Returns by how many ns it was set back since the last check, if by more than a second. A
    /// clock that is slewed, however far, does not count.
    pub(super) fn set_back(&mut self) -> Option<i64> {
        let (before, day, after) = (monotonic(), (self.shown)(), monotonic());
        if after.saturating_sub(before) > Self::MAX_GAP_NS {
            return None;
        }
        let ahead = day.saturating_sub(before);
        let back = self.ahead_ns.replace(ahead).map(|last| last.saturating_sub(ahead));
        back.filter(|back| *back > Self::MAX_NS)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    thread_local! {
        static SET: Cell<i64> = const { Cell::new(0) };
    }

    fn shown() -> i64 {
        SET.get() + monotonic()
    }

    #[test]
    fn a_time_of_day_that_is_set_back_by_more_than_a_second_is_noticed_once() {
        let mut day = ClockWatch::new(shown);
        let mut checks = |set: i64| {
            SET.set(set * 1_000_000_000);
            // If the thread is stopped between the two readings, the check is inconclusive and is
            // repeated.
            (0..3)
                .filter_map(|_| day.set_back())
                .map(|back| (back + 500_000_000) / 1_000_000_000)
                .collect::<Vec<_>>()
        };
        assert!(checks(1000).is_empty());
        assert!(checks(5000).is_empty(), "forward");
        assert_eq!(checks(4000), [1000]);
        assert!(checks(4000).is_empty());
        assert_eq!(checks(-10_000), [14_000]);
    }

    #[test]
    fn a_time_of_day_that_is_slewed_back_is_not_set_back() {
        let mut day = ClockWatch::new(shown);
        for step in 0..1000 {
            SET.set(step * -200_000_000);
            assert_eq!(day.set_back(), None, "step {step}");
        }
    }
}
