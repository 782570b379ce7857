//! How long things take, in bounded memory.

use gleaner_protocol::Spread;
use hdrhistogram::Histogram;

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
        let empty = || Histogram::new_with_max(MOST_NS, 2).expect("two digits up to a day are no problem");
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

fn spread(histogram: &Histogram<u64>) -> Option<Spread> {
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
        assert!((49_000..=51_000).contains(&p50_ns) && (100_000..=101_000).contains(&max_ns), "{p50_ns} {max_ns}");
        assert_eq!(spreads.take(), None);
        assert_eq!(spreads.all().unwrap().n, 101);
    }

    #[test]
    fn what_lasts_hours_is_told_as_that() {
        let mut spreads = Spreads::new();
        spreads.add(7_200_000_000_000);
        let Spread { p50_ns, max_ns, .. } = spreads.all().unwrap();
        assert!([p50_ns, max_ns].iter().all(|ns| ns / 100_000_000_000 == 72), "{p50_ns} {max_ns}");
    }
}
