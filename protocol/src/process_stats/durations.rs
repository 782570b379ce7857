//! Statistics of durations, in bounded memory.

use crate::counts::DurationStats;
use hdrhistogram::{Counter, Histogram};

/// Longer durations count as this: a day. Some topics have one sample in an hour.
const MAX_NS: u64 = 86_400_000_000_000;

/// Durations since the previous report, and since the start.
pub struct IntervalDurations {
    now: Histogram<u64>,
    all: Histogram<u64>,
}

impl Default for IntervalDurations {
    fn default() -> Self {
        Self::new()
    }
}

impl IntervalDurations {
    pub fn new() -> Self {
        let empty =
            || Histogram::new_with_max(MAX_NS, 2).expect("two digits up to a day are valid bounds");
        Self { now: empty(), all: empty() }
    }

    /// Adds a duration; a negative one, as from clocks that disagree, counts as 0.
    pub fn add(&mut self, ns: i64) {
        let ns = u64::try_from(ns).unwrap_or(0);
        self.now.saturating_record(ns);
        self.all.saturating_record(ns);
    }

    /// Returns the statistics since the last call, and resets them.
    pub fn take(&mut self) -> Option<DurationStats> {
        let stats = stats(&self.now);
        self.now.reset();
        stats
    }

    pub fn all(&self) -> Option<DurationStats> {
        stats(&self.all)
    }
}

/// Durations of one of many sources. The memory depends on the longest: 1 KiB at first, 9 KiB for
/// 10 ms, 20 KiB for a day. Counts saturate at 2^32 - 1 for each bucket.
pub struct Durations(Histogram<u32>);

impl Default for Durations {
    fn default() -> Self {
        Self::new()
    }
}

impl Durations {
    pub fn new() -> Self {
        Self(Histogram::new(2).expect("two digits are valid"))
    }

    /// Adds a duration; a negative one, as from clocks that disagree, counts as 0.
    pub fn add(&mut self, ns: i64) {
        let ns = u64::try_from(ns).unwrap_or(0).min(MAX_NS);
        // The histogram grows up to a day, so every value is in its range.
        self.0.record(ns).expect("it grows as far as it has to");
    }

    pub fn all(&self) -> Option<DurationStats> {
        stats(&self.0)
    }
}

fn stats<T: Counter>(histogram: &Histogram<T>) -> Option<DurationStats> {
    (!histogram.is_empty()).then(|| DurationStats {
        n: histogram.len(),
        p50_ns: histogram.value_at_quantile(0.5),
        p99_ns: histogram.value_at_quantile(0.99),
        max_ns: histogram.max(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_counted_since_the_last_report_and_since_the_start() {
        let mut spreads = IntervalDurations::new();
        assert_eq!(spreads.take(), None);
        (1..=100).for_each(|n| spreads.add(n * 1000));
        spreads.add(-5);
        let DurationStats { n, p50_ns, max_ns, .. } = spreads.take().unwrap();
        assert_eq!(n, 101);
        // The values have two significant digits.
        assert!(
            (49_000..=51_000).contains(&p50_ns) && (100_000..=101_000).contains(&max_ns),
            "{p50_ns} {max_ns}"
        );
        assert_eq!(spreads.take(), None);
        assert_eq!(spreads.all().unwrap().n, 101);
    }

    #[test]
    fn durations_of_one_source_are_as_exact_in_less_memory() {
        let (mut spreads, mut durations) = (IntervalDurations::new(), Durations::new());
        for ns in [-5, 0, 7, 10_000_000, 11_000_000, 7_200_000_000_000, i64::MAX] {
            spreads.add(ns);
            durations.add(ns);
            assert_eq!(durations.all(), spreads.all());
        }
        assert!(durations.0.distinct_values() * size_of::<u32>() <= 24 << 10);
    }

    #[test]
    fn durations_of_hours_are_exact_to_two_digits() {
        let mut spreads = IntervalDurations::new();
        spreads.add(7_200_000_000_000);
        let DurationStats { p50_ns, max_ns, .. } = spreads.all().unwrap();
        assert!([p50_ns, max_ns].iter().all(|ns| ns / 100_000_000_000 == 72), "{p50_ns} {max_ns}");
    }
}
