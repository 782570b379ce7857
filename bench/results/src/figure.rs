//! A row of a table: the values of some runs, and a goal for their median.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::statistics::Summary;

/// A bound that a median should keep.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Goal {
    /// The lowest value that is good enough.
    AtLeast(f64),
    /// The highest one.
    AtMost(f64),
}

/// A row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    /// The measured quantity.
    pub name: String,
    /// The unit of its values.
    pub unit: String,
    /// The bound of the median, if there is one.
    pub goal: Option<Goal>,
    /// A value for each run. JSON has no NaN, which is `null` there: what could not be measured.
    pub values: Vec<Option<f64>>,
}

impl Figure {
    /// Returns a row whose median should be `goal` or more. A goal that is itself measured, and
    /// could not be, is none.
    pub fn at_least(name: &str, unit: &str, goal: f64, values: &[f64]) -> Self {
        let goal = goal.is_finite().then_some(Goal::AtLeast(goal));
        Self { goal, ..Self::without_goal(name, unit, values) }
    }

    /// As [`at_least`](Self::at_least), for `goal` or less.
    pub fn at_most(name: &str, unit: &str, goal: f64, values: &[f64]) -> Self {
        let goal = goal.is_finite().then_some(Goal::AtMost(goal));
        Self { goal, ..Self::without_goal(name, unit, values) }
    }

    /// Returns a row for information.
    pub fn without_goal(name: &str, unit: &str, values: &[f64]) -> Self {
        let values = values.iter().map(|value| value.is_finite().then_some(*value)).collect();
        Self { name: name.to_owned(), unit: unit.to_owned(), goal: None, values }
    }

    /// Returns the statistics of the values; `None` if one could not be measured.
    pub fn summary(&self) -> Option<Summary> {
        let values: Option<Vec<f64>> = self.values.iter().copied().collect();
        Summary::of(&values?)
    }

    /// Returns whether the median keeps the goal. What was not measured does not.
    pub fn is_met(&self) -> bool {
        let Some(goal) = self.goal else { return true };
        self.summary().is_some_and(|summary| match goal {
            Goal::AtLeast(least) => summary.median >= least,
            Goal::AtMost(most) => summary.median <= most,
        })
    }

    /// Returns whether the goal is that there is none of it, as of errors and losses.
    pub fn is_of_errors(&self) -> bool {
        self.goal == Some(Goal::AtMost(0.0))
    }

    /// Returns the cells of the row: name, goal, median, spread, runs, and whether it is met.
    pub fn cells(&self) -> [String; 6] {
        let unit = &self.unit;
        let goal = match self.goal {
            Some(Goal::AtLeast(goal)) => format!(">= {goal} {unit}"),
            Some(Goal::AtMost(goal)) => format!("<= {goal} {unit}"),
            None => "-".to_owned(),
        };
        let result = match (self.goal, self.is_met()) {
            (None, _) => "",
            (Some(_), true) => "met",
            (Some(_), false) => "not met",
        };
        let (median, spread) = match self.summary() {
            Some(Summary { median, min, max, .. }) => {
                let digits = if median.abs() < 100.0 { 2 } else { 0 };
                let number = |value: f64| format!("{value:.digits$}");
                (
                    format!("{} {unit}", number(median)),
                    format!("{} to {}", number(min), number(max)),
                )
            }
            None => ("not measured".to_owned(), "-".to_owned()),
        };
        let runs = self.values.len().to_string();
        [self.name.clone(), goal, median, spread, runs, result.to_owned()]
    }
}

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "| {} |", self.cells().join(" | "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_is_for_the_median_and_what_is_not_measured_misses_it() {
        let row = Figure::at_most("latency", "us", 20.0, &[10.0, 19.0, 400.0]);
        assert!(row.is_met());
        assert_eq!(
            row.to_string(),
            "| latency | <= 20 us | 19.00 us | 10.00 to 400.00 | 3 | met |"
        );
        assert!(!Figure::at_least("rate", "Hz", 20.0, &[10.0]).is_met());
        let missing = Figure::at_most("errors", "", 0.0, &[f64::NAN]);
        assert!(!missing.is_met() && missing.to_string().contains("not measured"), "{missing}");
        let unknown = Figure::at_most("a", "", f64::NAN, &[1.0]);
        let text = serde_json::to_string(&unknown).unwrap();
        assert_eq!(serde_json::from_str::<Figure>(&text).unwrap(), unknown);
        assert!(missing.is_of_errors() && Figure::without_goal("", "", &[]).is_met());
    }
}
