//! How long things take, in bounded memory.

use gleaner_protocol::Spread;
use hdrhistogram::{Counter, Histogram};

/// What lasts longer counts as this: a day. There are topics that speak once in an hour.
const MOST_NS: u64 = 86_400_000_000_000;

/// Durations since the report before, and since the start.
pub struct Spreads {
    now: Histogram<u64>,
    all: Histogram<u64>,
}

impl Default for Spreads {
    fn default() -> Self {
        Self::new()
    }
}

impl Spreads {
    /// None so far.
    pub fn new() -> Self {
        let empty =
            || Histogram::new_with_max(MOST_NS, 2).expect("two digits up to a day are no problem");
        Self { now: empty(), all: empty() }
    }

    /// Adds a duration; a negative one, as of clocks that disagree, counts as none.
    pub fn add(&mut self, ns: i64) {
        let ns = u64::try_from(ns).unwrap_or(0);
        self.now.saturating_record(ns);
        self.all.saturating_record(ns);
    }

    /// Those since the last call.
    pub fn take(&mut self) -> Option<Spread> {
        let spread = spread(&self.now);
        self.now.reset();
        spread
    }

    /// All of them.
    pub fn all(&self) -> Option<Spread> {
        spread(&self.all)
    }
}

/// Durations of one of many sources. They take as much memory as the longest needs: 1 KiB at first,
/// 9 KiB for 10 ms, 20 KiB for a day. Of one kind more than four thousand million count as so many.
pub struct Durations(Histogram<u32>);

impl Default for Durations {
    fn default() -> Self {
        Self::new()
    }
}

impl Durations {
    /// None so far.
    pub fn new() -> Self {
        Self(Histogram::new(2).expect("two digits are no problem"))
    }

    /// Adds a duration; a negative one, as of clocks that disagree, counts as none.
    pub fn add(&mut self, ns: i64) {
        let ns = u64::try_from(ns).unwrap_or(0).min(MOST_NS);
        // It grows up to a day, so nothing is out of its range.
        self.0.record(ns).expect("it grows as far as it has to");
    }

    /// All of them.
    pub fn all(&self) -> Option<Spread> {
        spread(&self.0)
    }
}

fn spread<T: Counter>(histogram: &Histogram<T>) -> Option<Spread> {
    (!histogram.is_empty()).then(|| Spread {
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
    fn spreads_are_told_since_the_last_time_and_since_the_start() {
        let mut spreads = Spreads::new();
        assert_eq!(spreads.take(), None);
        (1..=100).for_each(|n| spreads.add(n * 1000));
        spreads.add(-5);
        let Spread { n, p50_ns, max_ns, .. } = spreads.take().unwrap();
        assert_eq!(n, 101);
        // Two digits.
        assert!(
            (49_000..=51_000).contains(&p50_ns) && (100_000..=101_000).contains(&max_ns),
            "{p50_ns} {max_ns}"
        );
        assert_eq!(spreads.take(), None);
        assert_eq!(spreads.all().unwrap().n, 101);
    }

    #[test]
    fn durations_of_one_source_are_as_exact_in_less_memory() {
        let (mut spreads, mut durations) = (Spreads::new(), Durations::new());
        for ns in [-5, 0, 7, 10_000_000, 11_000_000, 7_200_000_000_000, i64::MAX] {
            spreads.add(ns);
            durations.add(ns);
            assert_eq!(durations.all(), spreads.all());
        }
        assert!(durations.0.distinct_values() * size_of::<u32>() <= 24 << 10);
    }

    #[test]
    fn what_lasts_hours_is_told_as_that() {
        let mut spreads = Spreads::new();
        spreads.add(7_200_000_000_000);
        let Spread { p50_ns, max_ns, .. } = spreads.all().unwrap();
        assert!([p50_ns, max_ns].iter().all(|ns| ns / 100_000_000_000 == 72), "{p50_ns} {max_ns}");
    }
}
