//! Statistics of measured values, and the difference between two sets of them.

use serde::{Deserialize, Serialize};

/// Number of times that values are drawn again for an interval.
const RESAMPLES: usize = 1000;
/// Length of the blocks in which they are drawn: neighbours in time are not independent.
const BLOCK: usize = 25;
/// Fewest values that make an interval.
const FEWEST: usize = 5;

/// Statistics of a set of values, in their unit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Number of values.
    pub count: usize,
    /// The lowest value.
    pub min: f64,
    /// The arithmetic mean.
    pub mean: f64,
    /// The median.
    pub median: f64,
    /// The median absolute deviation from the median.
    pub mad: f64,
    /// The 95th percentile.
    pub p95: f64,
    /// The 99th percentile.
    pub p99: f64,
    /// The highest value.
    pub max: f64,
}

impl Summary {
    /// Returns the statistics of `values`; `None` if there are none, or one is not a number.
    pub fn of(values: &[f64]) -> Option<Self> {
        if values.is_empty() || values.iter().any(|value| value.is_nan()) {
            return None;
        }
        let sorted = sorted(values);
        let median = middle(&sorted);
        let deviations: Vec<f64> = values.iter().map(|value| (value - median).abs()).collect();
        Some(Self {
            count: sorted.len(),
            min: sorted[0],
            mean: sorted.iter().sum::<f64>() / sorted.len() as f64,
            median,
            mad: middle(&self::sorted(&deviations)),
            p95: at(&sorted, 0.95),
            p99: at(&sorted, 0.99),
            max: sorted[sorted.len() - 1],
        })
    }
}

/// The difference between two sets of values `a` and `b`, in the order of their measurement.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MeasuredDifference {
    /// Medians of `a` and `b`.
    pub medians: [f64; 2],
    /// The second one divided by the first one.
    pub ratio: f64,
    /// Interval of 95 % of the ratio, by drawing blocks of neighbours again; `None` with fewer than
    /// five values on a side.
    pub interval: Option<[f64; 2]>,
    /// Effect size, Cliff's delta: the share of pairs in which `b` is higher, minus that in which
    /// `a` is; -1 to 1.
    pub effect: f64,
    /// Probability of such an effect by chance, by the Mann-Whitney U test. It takes the values as
    /// independent, so that it is too small where they are not.
    pub p: f64,
}

impl MeasuredDifference {
    /// Compares `b` with `a`; `None` if one of them is empty or has something that is no number.
    pub fn between(a: &[f64], b: &[f64]) -> Option<Self> {
        let medians = [Summary::of(a)?.median, Summary::of(b)?.median];
        let (u, z) = mann_whitney(a, b);
        let is_enough = a.len().min(b.len()) >= FEWEST;
        Some(Self {
            medians,
            ratio: medians[1] / medians[0],
            interval: is_enough.then(|| ratio_interval(a, b)),
            effect: 2.0 * u / (a.len() as f64 * b.len() as f64) - 1.0,
            p: libm::erfc(z.abs() / std::f64::consts::SQRT_2),
        })
    }

    /// Returns whether the interval excludes 1, which means no difference.
    pub fn is_seen(&self) -> bool {
        self.interval.is_some_and(|[low, high]| low > 1.0 || high < 1.0)
    }
}

/// Returns the `share` quantile of `values`; NaN if there are none.
pub fn quantile(values: &[f64], share: f64) -> f64 {
    let sorted = sorted(values);
    if sorted.is_empty() { f64::NAN } else { at(&sorted, share) }
}

/// Returns the statistic U of `b`, which counts the pairs in which it is higher, and its standard
/// score. Equal values count as half, and widen the score.
fn mann_whitney(a: &[f64], b: &[f64]) -> (f64, f64) {
    let (n, m) = (a.len() as f64, b.len() as f64);
    let mut all: Vec<(f64, bool)> = a.iter().map(|value| (*value, false)).collect();
    all.extend(b.iter().map(|value| (*value, true)));
    all.sort_by(|left, right| left.0.total_cmp(&right.0));
    let (mut rank, mut rank_sum, mut ties) = (0.0, 0.0, 0.0);
    for equal in all.chunk_by(|left, right| left.0 == right.0) {
        let count = equal.len() as f64;
        let of_b = equal.iter().filter(|(_, is_b)| *is_b).count() as f64;
        rank_sum += of_b * (rank + (count + 1.0) / 2.0);
        rank += count;
        ties += count.powi(3) - count;
    }
    let u = rank_sum - m * (m + 1.0) / 2.0;
    let total = n + m;
    let variance = n * m / 12.0 * (total + 1.0 - ties / (total * (total - 1.0)));
    let off = u - n * m / 2.0;
    // The distribution of whole numbers, by a continuous one.
    let corrected = (off.abs() - 0.5).max(0.0);
    (u, if variance > 0.0 { corrected / variance.sqrt() } else { 0.0 })
}

fn ratio_interval(a: &[f64], b: &[f64]) -> [f64; 2] {
    // The same each time, so that a page can be made again.
    let mut random = 0x9e37_79b9_7f4a_7c15_u64;
    let mut below = move |bound: usize| {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        (random % bound as u64) as usize
    };
    let mut drawn_median = |values: &[f64]| {
        let block = BLOCK.min(values.len().div_ceil(FEWEST));
        let mut drawn = Vec::with_capacity(values.len() + block);
        while drawn.len() < values.len() {
            let begin = below(values.len() - block + 1);
            drawn.extend_from_slice(&values[begin..begin + block]);
        }
        drawn.truncate(values.len());
        let middle = drawn.len() / 2;
        *drawn.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    let mut ratios: Vec<f64> = (0..RESAMPLES).map(|_| drawn_median(b) / drawn_median(a)).collect();
    ratios.sort_by(f64::total_cmp);
    [0.025, 0.975].map(|share| at(&ratios, share))
}

fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
}

fn middle(sorted: &[f64]) -> f64 {
    let last = sorted.len() - 1;
    f64::midpoint(sorted[last / 2], sorted[last.div_ceil(2)])
}

/// Returns the lowest value of `sorted` that at least `share` of them do not exceed.
fn at(sorted: &[f64], share: f64) -> f64 {
    let index = (share * sorted.len() as f64).ceil() as usize;
    sorted[index.clamp(1, sorted.len()) - 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(count: usize, from: f64) -> Vec<f64> {
        // In an order that is none: neighbours would otherwise be alike.
        (0..count).map(|n| from + ((n * 7919) % count) as f64).collect()
    }

    #[test]
    fn a_summary_has_the_usual_statistics() {
        let summary = Summary::of(&[3.0, 1.0, 2.0, 4.0, 100.0]).unwrap();
        assert_eq!((summary.count, summary.min, summary.max), (5, 1.0, 100.0));
        assert_eq!((summary.median, summary.mean, summary.mad), (3.0, 22.0, 1.0));
        assert_eq!(Summary::of(&[1.0, 2.0]).unwrap().median, 1.5);
        let hundred = Summary::of(&numbers(100, 1.0)).unwrap();
        assert_eq!((hundred.p95, hundred.p99), (95.0, 99.0));
        assert_eq!(Summary::of(&[]), None);
        assert_eq!(Summary::of(&[1.0, f64::NAN]), None);
    }

    #[test]
    fn equal_sets_do_not_differ_and_shifted_ones_do() {
        let (a, b) = (numbers(200, 100.0), numbers(200, 150.0));
        let same = MeasuredDifference::between(&a, &a).unwrap();
        assert!(!same.is_seen() && same.effect.abs() < 1e-9 && same.p > 0.9, "{same:?}");
        let later = MeasuredDifference::between(&a, &b).unwrap();
        let [low, high] = later.interval.unwrap();
        assert!(later.is_seen() && low < later.ratio && later.ratio < high, "{later:?}");
        assert!((later.ratio - 1.25).abs() < 0.01 && later.p < 1e-6, "{later:?}");
        // Of the 40,000 pairs, 150 * 151 / 2 have a higher `a`, and 150 are equal.
        assert!((later.effect - (1.0 - 2.0 * 11_250.0 / 40_000.0)).abs() < 0.01, "{later:?}");
        let earlier = MeasuredDifference::between(&b, &a).unwrap();
        assert!((earlier.effect + later.effect).abs() < 1e-9);
    }

    #[test]
    fn the_test_agrees_with_a_worked_example() {
        // The times of tortoises and hares: U = 11 of 36 pairs.
        let (tortoises, hares) = ([1., 7., 8., 9., 10., 11.], [2., 3., 4., 5., 6., 12.]);
        let found = MeasuredDifference::between(&tortoises, &hares).unwrap();
        assert!((found.effect - (2.0 * 11.0 / 36.0 - 1.0)).abs() < 1e-9, "{found:?}");
        // The standard score, corrected for whole numbers, is 6.5 / sqrt(39).
        assert!((found.p - 0.298).abs() < 0.001, "{found:?}");
    }

    #[test]
    fn few_values_have_no_interval() {
        let few = MeasuredDifference::between(&[1.0, 1.1, 1.2], &[2.0, 2.1, 2.2]).unwrap();
        assert!(few.interval.is_none() && !few.is_seen() && few.effect == 1.0, "{few:?}");
    }
}
