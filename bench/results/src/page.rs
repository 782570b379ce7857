//! Results as a page with plots.

use gleaner_report::{MeasurementPage, MeasurementSection, Plot, PlotCurve, PlotTable};

use crate::growth::Growth;
use crate::markdown::COMPARED;
use crate::results::{BenchResults, Series, SeriesGroup};

/// Points of a curve below and above its 99th percentile: a tail has few values, which matter.
const POINTS: [usize; 2] = [200, 100];

/// Facts about the machine in the line below the title.
const ORIGIN: [&str; 5] = ["measured", "board", "processor", "kernel", "revision"];

impl BenchResults {
    /// Returns the page as one file.
    pub fn to_html(&self) -> String {
        let goals = ["measurement", "goal", "median", "spread", "runs", ""].map(str::to_owned);
        let figures = MeasurementSection {
            title: "Measurements".to_owned(),
            note: String::new(),
            plots: Vec::new(),
            tables: vec![PlotTable {
                heads: goals.to_vec(),
                rows: self.figures.iter().map(|figure| figure.cells().to_vec()).collect(),
            }],
        };
        let figures = (!self.figures.is_empty()).then_some(figures);
        let facts = self.machine.facts.iter();
        let groups = self.groups.iter().map(SeriesGroup::section);
        let growths = self.growths.iter().map(Growth::section);
        MeasurementPage {
            title: self.title(),
            origin: ORIGIN
                .iter()
                .filter_map(|name| self.machine.facts.get(*name).map(String::as_str))
                .collect::<Vec<_>>()
                .join(" · "),
            facts: facts.map(|(name, value)| (name.clone(), value.clone())).collect(),
            // The page has no markup.
            notes: self.notes.iter().map(|note| note.replace(['*', '`'], "")).collect(),
            recommendation: self.recommendation.clone(),
            sections: groups.chain(growths).chain(figures).collect(),
        }
        .to_html()
    }
}

impl Growth {
    fn section(&self) -> MeasurementSection {
        let curves = self.curves.iter();
        let curves = curves
            .map(|curve| PlotCurve { name: curve.name.clone(), points: curve.points.clone() });
        let plot = Plot {
            x: self.of.clone(),
            y: self.unit.clone(),
            is_x_logarithmic: false,
            curves: curves.collect(),
        };
        MeasurementSection {
            title: self.name.clone(),
            note: String::new(),
            plots: vec![plot],
            tables: vec![
                PlotTable { heads: self.heads(), rows: self.rows() },
                PlotTable { heads: self.slope_heads(), rows: self.slopes() },
            ],
        }
    }
}

impl SeriesGroup {
    fn section(&self) -> MeasurementSection {
        let curves = self.series.iter().filter(|series| !series.values.is_empty());
        let plot = Plot {
            x: self.unit.clone(),
            y: "cumulative fraction".to_owned(),
            is_x_logarithmic: true,
            curves: curves
                .map(|series| PlotCurve { name: series.name.clone(), points: ecdf(series) })
                .collect(),
        };
        let is_single = self.series.iter().all(|series| series.values.len() < 2);
        let rows = self.series.iter().map(|series| self.row(series)).collect();
        let mut tables = vec![PlotTable { heads: self.heads(), rows }];
        let compared = self.compared();
        if let Some(base) = self.base().filter(|_| !compared.is_empty()) {
            let first = format!("against {}", base.name);
            let heads = COMPARED.iter().map(|head| (*head).to_owned());
            let heads = [first].into_iter().chain(heads).collect();
            tables.push(PlotTable { heads, rows: compared });
        }
        MeasurementSection {
            title: self.name.clone(),
            note: format!("in {}", self.unit),
            // A single value has no distribution.
            plots: if is_single { Vec::new() } else { vec![plot] },
            tables,
        }
    }
}

/// Returns points of the empirical distribution: a value, and the share of all up to it.
fn ecdf(series: &Series) -> Vec<[f64; 2]> {
    let mut sorted = series.values.clone();
    sorted.sort_by(f64::total_cmp);
    let count = sorted.len();
    let [below, above] = POINTS;
    let shares = (1..=below)
        .map(|n| 0.99 * n as f64 / below as f64)
        .chain((1..=above).map(|n| 0.99 + 0.01 * n as f64 / above as f64));
    let indices = shares.map(|share| ((share * count as f64).ceil() as usize).clamp(1, count) - 1);
    let mut points: Vec<[f64; 2]> = Vec::new();
    for index in [0].into_iter().chain(indices) {
        let point = [sorted[index], (index + 1) as f64 / count as f64];
        if points.last() != Some(&point) {
            points.push(point);
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_value_has_a_row_and_no_plot() {
        let series = Series { name: "wasm".to_owned(), values: vec![1.0], ..Series::default() };
        let mut group = SeriesGroup { series: vec![series], ..SeriesGroup::default() };
        let section = group.section();
        assert!(section.plots.is_empty());
        assert_eq!(section.tables[0].heads[..2], ["side", "values"]);
        assert_eq!(section.tables[0].rows[0][..3], ["wasm", "1", "1.00"]);
        group.series[0].values.push(2.0);
        assert_eq!(group.section().plots.len(), 1);
    }

    #[test]
    fn a_distribution_begins_and_ends_with_the_extremes() {
        let values = (1..=10_000).rev().map(f64::from).collect();
        let points = ecdf(&Series { values, ..Series::default() });
        assert_eq!(points.first(), Some(&[1.0, 0.0001]));
        assert_eq!(points.last(), Some(&[10_000.0, 1.0]));
        assert!(points.is_sorted_by(|a, b| a[0] < b[0] && a[1] < b[1]));
        assert!(points.contains(&[9900.0, 0.99]));
    }
}
