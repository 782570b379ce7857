//! A measured figure beside the promised one.

use std::fmt;

/// A row of the table.
pub struct FleetFigure {
    name: String,
    unit: &'static str,
    most: Option<f64>,
    value: f64,
}

impl FleetFigure {
    /// A figure that must not exceed `most`.
    pub fn at_most(name: &str, unit: &'static str, most: f64, value: f64) -> Self {
        Self { name: name.to_owned(), unit, most: Some(most), value }
    }

    /// A figure without a promise.
    pub fn free(name: &str, unit: &'static str, value: f64) -> Self {
        Self { name: name.to_owned(), unit, most: None, value }
    }

    /// Returns whether it counts errors: only these are significant in a short run.
    pub fn is_of_errors(&self) -> bool {
        self.most == Some(0.0)
    }

    /// Returns whether the promise is kept. What was not measured is not.
    pub fn is_met(&self) -> bool {
        self.most.is_none_or(|most| self.value <= most)
    }
}

impl fmt::Display for FleetFigure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, unit, most, value } = self;
        let promise = most.map_or("-".to_owned(), |most| format!("<= {most} {unit}"));
        let result = match (most, self.is_met()) {
            (None, _) => "",
            (_, true) => "met",
            (_, false) => "not met",
        };
        let digits = if value.abs() < 100.0 { 2 } else { 0 };
        write!(f, "| {name} | {promise} | {value:.digits$} {unit} | {result} |")
    }
}

/// The `share` quantile of `values`; NaN if there are none.
pub fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    sorted.get((share * last as f64).ceil() as usize).copied().unwrap_or(f64::NAN)
}
