//! Counts the messages of one topic: sent, lost, late.

#[derive(Clone, Debug, Default)]
pub(crate) struct TopicCounts {
    pub(crate) sent: u64,
    /// Bytes sent, encapsulation included.
    pub(crate) bytes: u64,
    /// Not sent: readers did not acknowledge earlier messages in time, or Cyclone DDS refused them.
    pub(crate) refused: u64,
    /// Sent more than [`LATE_NS`] after they were due.
    pub(crate) late: u64,
    pub(crate) latest_ns: i64,
    /// Sent unchanged: too short for the stamp that their type has.
    pub(crate) unstamped: u64,
    pub(crate) writes: Durations,
}

/// Delay from which a message counts as late. A wake-up takes a tenth of a millisecond on an idle
/// machine and several milliseconds on a busy one.
pub(crate) const LATE_NS: i64 = 5_000_000;

/// A histogram of durations. Buckets are an eighth of a power of two wide: 12 % of a value, in 4
/// KiB.
#[derive(Clone, Debug)]
pub(crate) struct Durations {
    buckets: Vec<u64>,
    count: u64,
    longest_ns: u64,
}

/// Buckets per power of two.
const STEPS: u64 = 8;

impl Default for Durations {
    fn default() -> Durations {
        Durations { buckets: vec![0; 64 * STEPS as usize], count: 0, longest_ns: 0 }
    }
}

impl Durations {
    pub(crate) fn add(&mut self, ns: u64) {
        let power = u64::from(ns.max(STEPS).ilog2());
        let step = (ns.max(STEPS) >> (power - 3)) & (STEPS - 1);
        self.buckets[(power * STEPS + step) as usize] += 1;
        self.count += 1;
        self.longest_ns = self.longest_ns.max(ns);
    }

    /// The median, rounded up to the end of its bucket, at most the maximum. 0 if there are no
    /// durations.
    pub(crate) fn median_ns(&self) -> u64 {
        let mut before = 0;
        let at = self.buckets.iter().position(|bucket| {
            before += bucket;
            before * 2 >= self.count && self.count > 0
        });
        let Some(at) = at.map(|at| at as u64) else { return 0 };
        let (power, step) = (at / STEPS, at % STEPS);
        let end = (u128::from(STEPS + step + 1) << power) / u128::from(STEPS);
        u64::try_from(end).unwrap_or(u64::MAX).min(self.longest_ns)
    }

    pub(crate) fn longest_ns(&self) -> u64 {
        self.longest_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_at_most_an_eighth_too_high() {
        for scale in [1, 17, 1_000, 123_456_789] {
            let mut durations = Durations::default();
            (1..=1001).for_each(|n| durations.add(n * scale));
            let (true_median, found) = (501 * scale, durations.median_ns());
            assert!(
                (true_median..=true_median + true_median / 8).contains(&found),
                "{true_median} {found}"
            );
            assert_eq!(durations.longest_ns(), 1001 * scale);
        }
    }

    #[test]
    fn the_median_of_zero_or_one_duration_is_exact() {
        assert_eq!(Durations::default().median_ns(), 0);
        for ns in [0, 1, 9, u64::MAX] {
            let mut durations = Durations::default();
            durations.add(ns);
            assert_eq!(durations.median_ns(), ns);
        }
    }
}
