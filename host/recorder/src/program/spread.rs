//! How long things take, in bounded memory.

use gleaner_protocol::Spread;
use hdrhistogram::Histogram;

/// What lasts longer counts as this: a minute.
const MOST_NS: u64 = 60_000_000_000;

/// Durations since the report before, and since the start.
pub(super) struct Spreads {
    now: Histogram<u64>,
    all: Histogram<u64>,
}

impl Spreads {
    pub(super) fn new() -> Self {
        let empty = || Histogram::new_with_max(MOST_NS, 2).expect("two digits up to a minute are no problem");
        Self { now: empty(), all: empty() }
    }

    pub(super) fn add(&mut self, ns: u64) {
        self.now.saturating_record(ns);
        self.all.saturating_record(ns);
    }

    /// Those since the last call.
    pub(super) fn take(&mut self) -> Option<Spread> {
        let spread = spread(&self.now);
        self.now.reset();
        spread
    }

    /// All of them.
    pub(super) fn all(&self) -> Option<Spread> {
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
