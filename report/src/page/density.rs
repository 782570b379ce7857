//! Counts events over time in bounded memory: bins become wider as more of them are needed.

use std::collections::BTreeMap;

use serde::Serialize;

/// Maximum number of bins of all lanes together.
const BINS_MAX: usize = 4096;

/// Width of the first bins, as a power of two, in ns: about a millisecond.
const FIRST_SHIFT: u32 = 20;

#[derive(Debug)]
pub(super) struct Density {
    /// Bins are `1 << shift` ns wide.
    shift: u32,
    bins: BTreeMap<(usize, i64), u64>,
}

/// Number of events in `lane` from `from` to `to`, in s.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct DensityBin {
    pub(crate) lane: usize,
    pub(crate) from: f64,
    pub(crate) to: f64,
    pub(crate) count: u64,
}

impl Default for Density {
    fn default() -> Self {
        Self { shift: FIRST_SHIFT, bins: BTreeMap::new() }
    }
}

impl Density {
    /// Counts an event in `lane`, `after_ns` after the start.
    pub(super) fn add(&mut self, lane: usize, after_ns: i64) {
        *self.bins.entry((lane, after_ns >> self.shift)).or_default() += 1;
        // If there are as many lanes as bins, wider bins would not be fewer.
        while self.bins.len() > BINS_MAX && self.shift < 62 {
            self.shift += 1;
            let narrow = std::mem::take(&mut self.bins);
            for ((lane, bin), count) in narrow {
                *self.bins.entry((lane, bin >> 1)).or_default() += count;
            }
        }
    }

    /// Returns the bins if more events were counted than those `shown`.
    pub(super) fn bins_beyond(&self, shown: usize) -> Vec<DensityBin> {
        let has_more = self.bins.values().sum::<u64>() > shown as u64;
        if has_more { self.bins() } else { Vec::new() }
    }

    fn bins(&self) -> Vec<DensityBin> {
        let seconds = |bin: i64| (i128::from(bin) << self.shift) as f64 / 1e9;
        let dense = |(&(lane, bin), &count): (&(usize, i64), &u64)| DensityBin {
            lane,
            from: seconds(bin),
            to: seconds(bin.saturating_add(1)),
            count,
        };
        self.bins.iter().map(dense).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_million_events_are_counted_in_few_bins() {
        let mut density = Density::default();
        for event in 0..1_000_000_i64 {
            density.add((event % 3) as usize, event * 10_000_000);
        }
        let bins = density.bins();
        assert!(bins.len() <= BINS_MAX && bins.len() > BINS_MAX / 4, "{}", bins.len());
        assert_eq!(bins.iter().map(|bin| bin.count).sum::<u64>(), 1_000_000);
        assert!(bins.iter().all(|bin| bin.from < bin.to));
        assert_eq!(bins.iter().map(|bin| bin.lane).max(), Some(2));
    }

    #[test]
    fn times_at_the_ends_of_the_range_are_counted() {
        let mut density = Density::default();
        for at in [i64::MIN, -1, 0, i64::MAX] {
            density.add(0, at);
        }
        assert_eq!(density.bins().iter().map(|bin| bin.count).sum::<u64>(), 4);
    }
}
