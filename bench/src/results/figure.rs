//! A row of a table: the values of some runs, and a goal for their median.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::statistics::median;

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

    /// Returns the median of the values; `None` if one could not be measured.
    fn median(&self) -> Option<f64> {
        median(&self.values.iter().copied().collect::<Option<Vec<f64>>>()?)
    }

    /// Returns whether the median keeps the goal. What was not measured does not.
    pub fn is_met(&self) -> bool {
        let Some(goal) = self.goal else { return true };
        self.median().is_some_and(|median| match goal {
            Goal::AtLeast(least) => median >= least,
            Goal::AtMost(most) => median <= most,
        })
    }

    /// Returns whether the goal is that there is none of it, as of errors and losses.
    pub fn is_of_errors(&self) -> bool {
        self.goal == Some(Goal::AtMost(0.0))
    }
}

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.median() {
            Some(median) => write!(f, "{}: {median:.2} {}", self.name, self.unit)?,
            None => write!(f, "{}: not measured", self.name)?,
        }
        f.write_str(if self.is_met() { "" } else { " (goal not met)" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_is_for_the_median_and_what_is_not_measured_misses_it() {
        let row = Figure::at_most("latency", "us", 20.0, &[10.0, 19.0, 400.0]);
        assert!(row.is_met());
        assert!(!Figure::at_least("rate", "Hz", 20.0, &[10.0]).is_met());
        let missing = Figure::at_most("errors", "", 0.0, &[f64::NAN]);
        assert!(!missing.is_met() && missing.values == [None]);
        assert_eq!(missing.to_string(), "errors: not measured (goal not met)");
        let unknown = Figure::at_most("a", "", f64::NAN, &[1.0]);
        let text = serde_json::to_string(&unknown).unwrap();
        assert_eq!(serde_json::from_str::<Figure>(&text).unwrap(), unknown);
        assert!(missing.is_of_errors() && Figure::without_goal("", "", &[]).is_met());
    }
}
