//! Two runs of a benchmark, compared row by row.

use crate::markdown::{COMPARED, number, table};
use crate::results::BenchResults;
use crate::statistics::MeasuredDifference;

/// The rows that two runs have in common, and those that only one of them has.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Comparison {
    rows: Vec<ComparedFigure>,
    /// Names that only one of the runs has.
    pub alone: Vec<String>,
    /// Facts about the machine that differ.
    pub machines: Vec<String>,
}

/// A row or a series of both runs.
#[derive(Debug, Clone, PartialEq)]
struct ComparedFigure {
    name: String,
    unit: String,
    difference: MeasuredDifference,
}

impl Comparison {
    /// Compares `b` with `a`.
    pub fn between(a: &BenchResults, b: &BenchResults) -> Self {
        let mut comparison = Self::default();
        let [of_a, of_b] = [a, b].map(measured);
        for (name, unit, values) in &of_a {
            let other =
                of_b.iter().find(|(other, other_unit, _)| (other, other_unit) == (name, unit));
            let Some((.., others)) = other else {
                comparison.alone.push(name.clone());
                continue;
            };
            let Some(difference) = MeasuredDifference::between(values, others) else { continue };
            comparison.rows.push(ComparedFigure {
                name: name.clone(),
                unit: unit.clone(),
                difference,
            });
        }
        let is_known = |name: &String| of_a.iter().any(|(known, ..)| known == name);
        let new = of_b.iter().map(|(name, ..)| name.clone()).filter(|name| !is_known(name));
        comparison.alone.extend(new);
        for (name, value) in &a.machine.facts {
            let other = b.machine.facts.get(name).map_or("unknown", String::as_str);
            if other != value {
                comparison.machines.push(format!("{name}: {value}, and {other}"));
            }
        }
        comparison
    }

    /// Returns a table, with a verdict for each row.
    pub fn to_markdown(&self) -> String {
        let heads = [&["measurement", "A", "B"][..], &COMPARED, &["B is"]].concat();
        let heads: Vec<String> = heads.into_iter().map(str::to_owned).collect();
        let rows = self.rows.iter().map(|row| {
            let medians =
                row.difference.medians.map(|median| format!("{} {}", number(median), row.unit));
            let mut cells = vec![row.name.clone()];
            cells.extend(medians);
            cells.extend(row.difference.cells());
            cells.push(verdict(&row.difference));
            cells
        });
        let mut text = String::new();
        table(&mut text, &heads, rows);
        for (what, names) in
            [("only in one of them", &self.alone), ("the machines differ", &self.machines)]
        {
            for name in names {
                text.push_str(&format!("\n- {what}: {name}"));
            }
        }
        text.push('\n');
        text
    }
}

/// Returns name, unit and values of all that was measured.
fn measured(results: &BenchResults) -> Vec<(String, String, Vec<f64>)> {
    let figures = results.figures.iter().map(|figure| {
        let values = figure.values.iter().copied().flatten().collect();
        (figure.name.clone(), figure.unit.clone(), values)
    });
    let series = results.groups.iter().flat_map(|group| {
        group.series.iter().map(|series| {
            let name = format!("{}: {}", group.name, series.name);
            (name, group.unit.clone(), series.values.clone())
        })
    });
    figures.chain(series).collect()
}

fn verdict(difference: &MeasuredDifference) -> String {
    let Some([low, high]) = difference.interval else {
        return "too few runs for a verdict".to_owned();
    };
    if !difference.is_seen() {
        return "no difference seen".to_owned();
    }
    let percent = |ratio: f64| 100.0 * (ratio - 1.0).abs();
    let (word, [least, most]) = match difference.ratio > 1.0 {
        true => ("higher", [percent(low), percent(high)]),
        false => ("lower", [percent(high), percent(low)]),
    };
    format!("{word} by {:.0} % ({least:.0} to {most:.0})", percent(difference.ratio))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::tests::example;

    #[test]
    fn each_row_has_an_effect_and_an_interval() {
        let (a, mut b) = (example(0.0), example(0.5));
        b.machine.facts.insert("kernel".to_owned(), "6.6".to_owned());
        b.figures[0].name = "other".to_owned();
        let text = Comparison::between(&a, &b).to_markdown();
        assert!(text.contains("| IMU \\| 100 Hz: bare | 1.50 ms | 1.50 ms | 1.00 |"), "{text}");
        assert!(text.contains("| no difference seen |"), "{text}");
        assert!(text.contains("| higher by 25 % ("), "{text}");
        assert!(text.contains("- only in one of them: wake"), "{text}");
        assert!(text.contains("- only in one of them: other"), "{text}");
        assert!(text.contains("- the machines differ: kernel: "), "{text}");
    }

    #[test]
    fn too_few_runs_have_no_verdict() {
        let a = example(0.0);
        let text = Comparison::between(&a, &a).to_markdown();
        let wake = text.lines().find(|line| line.contains("wake")).unwrap();
        assert!(wake.ends_with("| too few runs for a verdict |"), "{wake}");
    }
}
