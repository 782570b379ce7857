//! The statistics that a benchmark itself needs; `bench/analysis` has the others.

/// Returns the median of `values`; `None` if there are none, or one is not a number.
pub fn median(values: &[f64]) -> Option<f64> {
    if values.iter().any(|value| value.is_nan()) {
        return None;
    }
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    Some(f64::midpoint(sorted[last / 2], sorted[last.div_ceil(2)]))
}

/// Returns the lowest of `values` that at least `share` of them do not exceed; NaN if there are
/// none.
pub fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let index = (share * sorted.len() as f64).ceil() as usize;
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    sorted[index.clamp(1, last + 1) - 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_median_is_between_two_values_and_a_quantile_is_one_of_them() {
        assert_eq!(median(&[3.0, 1.0, 2.0, 4.0]), Some(2.5));
        assert_eq!((median(&[]), median(&[1.0, f64::NAN])), (None, None));
        let hundred: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!(
            [0.0, 0.95, 0.99, 1.0].map(|share| quantile(&hundred, share)),
            [1., 95., 99., 100.]
        );
        assert!(quantile(&[], 0.5).is_nan());
    }
}
