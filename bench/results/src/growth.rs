//! A quantity that grows with another one, as the CPU time with the number of lambdas.

use serde::{Deserialize, Serialize};

use crate::markdown::number;

/// Curves over a common quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Growth {
    /// The measured quantity, and its conditions.
    pub name: String,
    /// The quantity that is set, in plural: `lambdas`.
    pub of: String,
    /// The unit of what is measured.
    pub unit: String,
    /// The curves.
    pub curves: Vec<GrowthCurve>,
}

/// A curve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GrowthCurve {
    /// Its name.
    pub name: String,
    /// Pairs of the number that was set, and the measured value.
    pub points: Vec<[f64; 2]>,
}

impl Growth {
    /// Returns the heads of its table.
    pub(crate) fn heads(&self) -> Vec<String> {
        let names = self.curves.iter().map(|curve| format!("{}, {}", curve.name, self.unit));
        [self.of.clone()].into_iter().chain(names).collect()
    }

    /// Returns its rows: one for each value that was set.
    pub(crate) fn rows(&self) -> Vec<Vec<String>> {
        let mut set: Vec<f64> =
            self.curves.iter().flat_map(|curve| curve.points.iter().map(|[x, _]| *x)).collect();
        set.sort_by(f64::total_cmp);
        set.dedup();
        let row = |x: f64| {
            let measured = self.curves.iter().map(|curve| {
                let point = curve.points.iter().find(|[at, _]| *at == x);
                point.map_or_else(|| "-".to_owned(), |[_, y]| number(*y))
            });
            [format!("{x}")].into_iter().chain(measured).collect()
        };
        set.into_iter().map(row).collect()
    }

    /// Returns the heads of the table of slopes.
    pub(crate) fn slope_heads(&self) -> Vec<String> {
        let slope = format!("{} for each further one of the {}", self.unit, self.of);
        vec!["slope (least squares)".to_owned(), slope, "from, to".to_owned()]
    }

    /// Returns a row for each curve with a slope.
    pub(crate) fn slopes(&self) -> Vec<Vec<String>> {
        let row = |curve: &GrowthCurve| {
            let slope = curve.slope()?;
            let [first, last] = [curve.points.first()?[0], curve.points.last()?[0]];
            let sign = if slope < 0.0 { "" } else { "+" };
            Some(vec![
                curve.name.clone(),
                format!("{sign}{}", number(slope)),
                format!("{first}, {last}"),
            ])
        };
        self.curves.iter().filter_map(row).collect()
    }
}

impl GrowthCurve {
    /// Returns the slope of the line with the least squares; `None` with fewer than two places.
    fn slope(&self) -> Option<f64> {
        let count = self.points.len() as f64;
        let mean = |at: usize| self.points.iter().map(|point| point[at]).sum::<f64>() / count;
        let [x, y] = [0, 1].map(mean);
        let squares: f64 = self.points.iter().map(|point| (point[0] - x).powi(2)).sum();
        let products: f64 = self.points.iter().map(|point| (point[0] - x) * (point[1] - y)).sum();
        (squares > 0.0).then(|| products / squares)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_growth_has_a_table_and_its_slope_in_words() {
        let curve = |name: &str, points: &[[f64; 2]]| GrowthCurve {
            name: name.to_owned(),
            points: points.to_vec(),
        };
        let growth = Growth {
            name: "CPU".to_owned(),
            of: "lambdas".to_owned(),
            unit: "% of a core".to_owned(),
            curves: vec![
                curve("wasm", &[[1.0, 5.0], [4.0, 6.5], [16.0, 12.5]]),
                curve("Python", &[[4.0, 7.0]]),
            ],
        };
        assert_eq!(growth.heads(), ["lambdas", "wasm, % of a core", "Python, % of a core"]);
        assert_eq!(growth.rows()[..2], [["1", "5.00", "-"], ["4", "6.50", "7.00"]]);
        assert_eq!(growth.slope_heads()[1], "% of a core for each further one of the lambdas");
        assert_eq!(growth.slopes(), [["wasm", "+0.500", "1, 16"]]);
    }
}
