//! Notices that the time of day was set back: RustDDS depends on it.

use gleaner_transport::clock::monotonic;

/// Notices that the time of day was set back.
///
/// RustDDS orders what readers of best effort get by the time of day at which it came,
/// announcements of participants included, and shows nothing that is later than now.
#[derive(Debug)]
pub(super) struct Day {
    shown: fn() -> i64,
    /// How far it was ahead of `CLOCK_MONOTONIC` at the last look, in ns.
    ahead_ns: Option<i64>,
}

impl Day {
    /// Less is not worth a restart: after so long all is well again.
    const MOST_NS: i64 = 1_000_000_000;
    /// Between two looks at `CLOCK_MONOTONIC`; if it was longer, the thread was stopped between
    /// them.
    const AT_ONCE_NS: i64 = 100_000_000;

    /// `shown` tells the time of day, in ns.
    pub(super) fn new(shown: fn() -> i64) -> Self {
        Self { shown, ahead_ns: None }
    }

    /// By how many ns it was set back since the last look, if that is more than a second. A clock
    /// that is slewed, however far, is not set.
    pub(super) fn set_back(&mut self) -> Option<i64> {
        let (before, day, after) = (monotonic(), (self.shown)(), monotonic());
        if after.saturating_sub(before) > Self::AT_ONCE_NS {
            return None;
        }
        let ahead = day.saturating_sub(before);
        let back = self.ahead_ns.replace(ahead).map(|last| last.saturating_sub(ahead));
        back.filter(|back| *back > Self::MOST_NS)
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
        let mut day = Day::new(shown);
        let mut looks = |set: i64| {
            SET.set(set * 1_000_000_000);
            // A thread that is stopped between two looks does not know, and looks again.
            (0..3)
                .filter_map(|_| day.set_back())
                .map(|back| (back + 500_000_000) / 1_000_000_000)
                .collect::<Vec<_>>()
        };
        assert!(looks(1000).is_empty());
        assert!(looks(5000).is_empty(), "forward");
        assert_eq!(looks(4000), [1000]);
        assert!(looks(4000).is_empty());
        assert_eq!(looks(-10_000), [14_000]);
    }

    #[test]
    fn a_time_of_day_that_is_slewed_back_is_not_set_back() {
        let mut day = Day::new(shown);
        for step in 0..1000 {
            SET.set(step * -200_000_000);
            assert_eq!(day.set_back(), None, "step {step}");
        }
    }
}
