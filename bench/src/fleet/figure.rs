//! A measured figure beside the promised one.

use gleaner_bench::Figure;

/// Returns a figure that must not exceed `most`.
pub fn at_most(name: &str, unit: &str, most: f64, value: f64) -> Figure {
    Figure::at_most(name, unit, most, &[value])
}

/// Returns a figure without a promise.
pub fn free(name: &str, unit: &str, value: f64) -> Figure {
    Figure::without_goal(name, unit, &[value])
}
