//! Results as tables in Markdown.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use crate::results::{BenchResults, Series, SeriesGroup};
use crate::statistics::{MeasuredDifference, Summary};

/// Heads of the statistics of a series, as in the table of the paper, and three more.
pub(crate) const STATISTICS: [&str; 7] = ["min", "mean", "median", "MAD", "p95", "p99", "max"];
/// Heads of a comparison.
pub(crate) const COMPARED: [&str; 4] =
    ["median ratio", "95 % interval", "effect (Cliff's delta)", "p (Mann-Whitney U)"];

impl BenchResults {
    /// Returns the tables, with the machine and the notes.
    pub fn to_markdown(&self) -> String {
        let mut text = format!("# {}\n", self.title());
        for (name, value) in &self.machine.facts {
            let _ = write!(text, "\n- {name}: {value}");
        }
        text.push('\n');
        if !self.figures.is_empty() {
            let heads = ["measurement", "goal", "median", "spread", "runs", ""];
            let rows = self.figures.iter().map(|figure| figure.cells().to_vec());
            table(&mut text, &heads.map(str::to_owned), rows);
        }
        for group in &self.groups {
            let _ = write!(text, "\n## {}, in {}\n", group.name, group.unit);
            table(&mut text, &group.heads(), group.series.iter().map(|series| group.row(series)));
            let compared = group.compared();
            if let Some(base) = group.base().filter(|_| !compared.is_empty()) {
                let _ = write!(text, "\nAgainst {}:\n", base.name);
                let heads = [&["side"][..], &COMPARED].concat();
                let heads: Vec<String> = heads.into_iter().map(str::to_owned).collect();
                table(&mut text, &heads, compared.into_iter());
            }
        }
        for growth in &self.growths {
            let _ = write!(text, "\n## {}\n", growth.name);
            table(&mut text, &growth.heads(), growth.rows().into_iter());
            table(&mut text, &growth.slope_heads(), growth.slopes().into_iter());
        }
        if !self.notes.is_empty() {
            text.push('\n');
        }
        for note in &self.notes {
            let _ = writeln!(text, "- {note}");
        }
        if !self.recommendation.is_empty() {
            text.push_str("\n## Recommendation\n\n");
        }
        for sentence in &self.recommendation {
            let _ = writeln!(text, "- {sentence}");
        }
        text
    }

    /// Returns a title for people.
    pub(crate) fn title(&self) -> String {
        let quick = if self.is_quick { " (smoke test: values are not meaningful)" } else { "" };
        format!("Gleaner bench: {}{quick}", self.bench)
    }
}

impl SeriesGroup {
    /// Returns the heads of the table of its series.
    pub(crate) fn heads(&self) -> Vec<String> {
        let has_reception = self.series.iter().any(|series| series.reception.is_some());
        let count = if has_reception { "answered of sent" } else { "values" };
        let heads = [&["side", count][..], &STATISTICS].concat();
        heads.into_iter().map(str::to_owned).chain(self.details()).collect()
    }

    /// Returns the row of one of its series.
    pub(crate) fn row(&self, series: &Series) -> Vec<String> {
        let received = match &series.reception {
            Some(reception) => format!("{} of {}", reception.answered, reception.sent),
            None => series.values.len().to_string(),
        };
        let numbers = match Summary::of(&series.values) {
            Some(Summary { min, mean, median, mad, p95, p99, max, .. }) => {
                [min, mean, median, mad, p95, p99, max].map(number)
            }
            None => std::array::from_fn(|_| "-".to_owned()),
        };
        let details = self.details();
        let details =
            details.iter().map(|name| series.details.get(name).cloned().unwrap_or_default());
        [series.name.clone(), received].into_iter().chain(numbers).chain(details).collect()
    }

    /// Returns a row for each series but the base, which it is compared with.
    pub(crate) fn compared(&self) -> Vec<Vec<String>> {
        let Some(base) = self.base() else { return Vec::new() };
        let others = self.series.iter().filter(|series| series.name != base.name);
        let rows = others.filter_map(|series| {
            let difference = MeasuredDifference::between(&base.values, &series.values)?;
            Some([vec![series.name.clone()], difference.cells().to_vec()].concat())
        });
        rows.collect()
    }

    /// Returns the names of all details of its series.
    fn details(&self) -> Vec<String> {
        let names: BTreeSet<&String> =
            self.series.iter().flat_map(|series| series.details.keys()).collect();
        names.into_iter().cloned().collect()
    }
}

impl MeasuredDifference {
    /// Returns the cells of a comparison, in the order of its heads.
    pub(crate) fn cells(&self) -> [String; 4] {
        let interval = match self.interval {
            Some([low, high]) => format!("{low:.2} to {high:.2}"),
            None => "too few values".to_owned(),
        };
        let p = if self.p < 0.001 { "< 0.001".to_owned() } else { format!("{:.3}", self.p) };
        // None of something has no ratio to none of it.
        let ratio =
            if self.ratio.is_finite() { format!("{:.2}", self.ratio) } else { "-".to_owned() };
        [ratio, interval, format!("{:+.2}", self.effect), p]
    }
}

/// Returns a number with three digits, or two after the point.
pub(crate) fn number(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 1.0 || size == 0.0 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}

/// Appends a table.
pub(crate) fn table(text: &mut String, heads: &[String], rows: impl Iterator<Item = Vec<String>>) {
    text.push('\n');
    let mut line = |cells: &[String]| {
        let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
        let _ = writeln!(text, "| {} |", cells.join(" | "));
    };
    line(heads);
    line(&vec!["---".to_owned(); heads.len()]);
    rows.for_each(|row| line(&row));
}
