//! Wakes of the last minutes: faults of now count although a lambda was healthy for hours.

use std::time::{Duration, Instant};

use gleaner_protocol::WakeCounts;

/// Time and number of wakes of a period. Of the current one and the one before it, wakes count.
const PERIOD: Duration = Duration::from_secs(60);
const PERIOD_WAKES: u64 = 20;

/// The wakes of the current period, and of the one before it.
#[derive(Debug, Default)]
pub(crate) struct RecentWakes {
    /// Counts at the start of the period before.
    before: WakeCounts,
    /// Start of the current period, with the counts then.
    start: Option<(Instant, WakeCounts)>,
    recent: WakeCounts,
}

impl RecentWakes {
    /// Adds the counts `all` since the start, as they are at `now`.
    pub(crate) fn add(&mut self, all: WakeCounts, now: Instant) {
        let (started, counts) = *self.start.get_or_insert((now, WakeCounts::default()));
        if now.duration_since(started) >= PERIOD && all.since(counts).all() >= PERIOD_WAKES {
            (self.before, self.start) = (counts, Some((now, all)));
        }
        self.recent = all.since(self.before);
    }

    /// Returns the wakes as of the last call of [`add`](Self::add).
    pub(crate) fn get(&self) -> WakeCounts {
        self.recent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the second in which a lambda is faulty: it wakes `per_second` times, and each wake
    /// from the second `from` on is a fault.
    fn faulty_at(per_second: f64, from: u64) -> Option<u64> {
        let start = Instant::now();
        let mut recent = RecentWakes::default();
        (1..=20_000).find(|second| {
            let count = |seconds: u64| (seconds as f64 * per_second) as u64;
            let (wakes, healthy) = (count(*second), count((*second).min(from)));
            let all = WakeCounts { wakes, faults: wakes - healthy, backed_off: 0 };
            recent.add(all, start + Duration::from_secs(*second));
            recent.get().faulty().is_some()
        })
    }

    #[test]
    fn faults_count_at_once_and_after_hours_of_health() {
        assert_eq!(faulty_at(10.0, 0), Some(1));
        let late = faulty_at(10.0, 10_000).unwrap();
        assert!((10_030..10_130).contains(&late), "{late}");
        // One that wakes rarely has as many wakes to be judged by.
        let rarely = faulty_at(0.1, 10_000).unwrap();
        assert!((10_100..10_500).contains(&rarely), "{rarely}");
        assert_eq!(faulty_at(10.0, 20_000), None);
    }
}
