//! The reasons why a vehicle has not applied a part of the desired state.

use prost::Message;
use serde::{Deserialize, Serialize};

/// Maximum number of problems in a report.
pub const PROBLEMS_MAX: usize = 100;
/// Maximum number of causes of a problem.
pub const CAUSES_MAX: usize = 8;
/// Maximum length of each text of a problem, in characters.
pub const PROBLEM_TEXT_MAX: usize = 300;

/// The reason why a wanted deployment is not applied.
#[derive(Clone, PartialEq, Eq, Hash, Message, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default)]
pub struct WantedProblem {
    /// Id of the deployment.
    #[prost(string, tag = "1")]
    pub deployment: String,
    /// SHA-256 of its signed envelope.
    #[prost(string, tag = "2")]
    pub envelope: String,
    /// The failed action.
    #[prost(string, tag = "3")]
    pub title: String,
    /// True if the vehicle could not fetch it yet, and goes on by itself; false if it refuses it.
    #[prost(bool, tag = "4")]
    pub is_pending: bool,
    /// The causes, the nearest first.
    #[prost(string, repeated, tag = "5")]
    pub causes: Vec<String>,
    /// Help for the user; empty without any.
    #[prost(string, tag = "6")]
    pub help: String,
}

impl WantedProblem {
    /// Returns the action and its causes in one line, safe to print.
    pub fn describe(&self) -> String {
        gleaner_base::text::describe(&self.title, &self.causes)
    }

    /// Returns the deployment, the action, its causes and the help in one line, safe to print.
    pub fn explained(&self) -> String {
        let subject = match self.deployment.is_empty() {
            true => String::new(),
            false => format!("{}: ", gleaner_base::visible(&self.deployment)),
        };
        let help = match self.help.is_empty() {
            true => String::new(),
            false => format!(". {}", gleaner_base::visible(&self.help)),
        };
        format!("{subject}{}{help}", self.describe())
    }

    /// Returns the problem with at most [`CAUSES_MAX`] causes, and [`PROBLEM_TEXT_MAX`] characters
    /// of each text, safe to print.
    pub fn bounded(&self) -> Self {
        Self {
            deployment: gleaner_base::excerpt(&self.deployment),
            envelope: gleaner_base::excerpt(&self.envelope),
            title: problem_text(&self.title),
            is_pending: self.is_pending,
            causes: self.causes.iter().take(CAUSES_MAX).map(|cause| problem_text(cause)).collect(),
            help: problem_text(&self.help),
        }
    }
}

/// Returns at most [`PROBLEM_TEXT_MAX`] characters of a text of a problem, safe to print.
pub fn problem_text(text: &str) -> String {
    gleaner_base::visible(&text.chars().take(PROBLEM_TEXT_MAX).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_problem_is_explained_in_one_line_with_its_deployment_and_the_way_out() {
        let mut problem = WantedProblem { title: "no\nroom".to_owned(), ..Default::default() };
        assert_eq!(problem.explained(), "no\\nroom");
        problem.deployment = "brake".to_owned();
        problem.causes = vec!["the disk is full".to_owned()];
        problem.help = "remove clips".to_owned();
        assert_eq!(problem.explained(), "brake: no\\nroom: the disk is full. remove clips");
    }
}
