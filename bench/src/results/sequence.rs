//! Several benchmarks, one after the other, and what each of them ended with.

use std::fmt::{self, Write as _};
use std::fs;
use std::path::Path;

use crate::results::BenchResults;

/// Name of the file with the output of a benchmark, beside its results.
pub const OUTPUT: &str = "output.txt";

/// A benchmark that was started, or was not to be.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceEntry {
    /// Its name.
    pub bench: String,
    /// Its duration in seconds.
    pub seconds: f64,
    /// Its end.
    pub end: BenchEnd,
}

/// The end of a benchmark.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BenchEnd {
    /// It has results.
    Measured {
        /// The number of its goals.
        goals: usize,
        /// The number of those that were missed.
        missed: usize,
        /// Parts that were skipped, with the reasons.
        skipped_parts: Vec<String>,
    },
    /// It cannot run here, or was not to run, for this reason.
    Skipped(String),
    /// It failed: its exit status, and its message.
    Failed(String),
}

impl BenchEnd {
    /// Reads the end of a benchmark from the folder of its results and of its [`OUTPUT`]. `status`
    /// describes its exit status.
    pub fn read(folder: &Path, is_skipped: bool, status: &str) -> Self {
        let output = fs::read(folder.join(OUTPUT)).unwrap_or_default();
        let output = String::from_utf8_lossy(&output);
        let stored = BenchResults::read(folder).ok().filter(|results| results.is_complete);
        if let Some(results) = stored {
            // The values of a quick run mean nothing.
            let figures = results.figures.iter().filter(|_| !results.is_quick);
            let goals = figures.filter(|figure| figure.goal.is_some());
            let missed = goals.clone().filter(|figure| !figure.is_met());
            let skipped = results.notes.iter().filter(|note| note.contains("skipped"));
            return Self::Measured {
                goals: goals.count(),
                missed: missed.count(),
                skipped_parts: skipped.cloned().collect(),
            };
        }
        let reason = output.lines().find_map(|line| line.strip_prefix("skipped: "));
        if let Some(reason) = reason.filter(|_| is_skipped) {
            return Self::Skipped(reason.to_owned());
        }
        let mut words = status.to_owned();
        // A panic prints its message below its place, and many lines after that.
        let message = output.lines().skip_while(|line| !line.contains("panicked at")).nth(1);
        if let Some(line) = message.or_else(|| output.lines().rfind(|line| !line.trim().is_empty()))
        {
            let _ = write!(words, ": {}", line.trim());
        }
        Self::Failed(words)
    }

    /// Returns whether it has results, and met all goals, or was skipped.
    pub fn is_good(&self) -> bool {
        matches!(self, Self::Measured { missed: 0, .. } | Self::Skipped(_))
    }
}

impl SequenceEntry {
    /// Returns a list of all benchmarks, with the reasons of what was skipped or failed.
    pub fn to_markdown(entries: &[Self]) -> String {
        let mut text = "# Gleaner bench: all\n\n".to_owned();
        for Self { bench, seconds, end } in entries {
            let _ = writeln!(text, "- {bench}, {seconds:.0} s: {end}");
            if let BenchEnd::Measured { skipped_parts, .. } = end {
                skipped_parts.iter().for_each(|part| _ = writeln!(text, "  - {part}"));
            }
        }
        text
    }
}

impl fmt::Display for BenchEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Measured { goals: 0, .. } => f.write_str("measured"),
            Self::Measured { goals, missed, .. } => {
                write!(f, "measured, {} of {goals} goals met", goals - missed)
            }
            Self::Skipped(reason) => write!(f, "skipped: {reason}"),
            Self::Failed(reason) => write!(f, "FAILED: {reason}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::figure::Figure;
    use gleaner_test_support::TestFolder;

    #[test]
    fn results_count_whatever_the_exit_code_is() {
        let folder = TestFolder::new();
        let mut results = BenchResults::new("rtt", false);
        results.figures.push(Figure::at_most("slow", "us", 1.0, &[2.0]));
        results.figures.push(Figure::at_most("fast", "us", 3.0, &[2.0]));
        results.figures.push(Figure::without_goal("any", "us", &[2.0]));
        results.is_complete = true;
        results.notes = vec!["rclpy: skipped: no module".to_owned(), "A note.".to_owned()];
        results.store(&folder.path("rtt")).unwrap();
        let end = BenchEnd::read(&folder.path("rtt"), false, "exit status: 1");
        let skipped_parts = vec!["rclpy: skipped: no module".to_owned()];
        assert_eq!(end, BenchEnd::Measured { goals: 2, missed: 1, skipped_parts });
        assert!(!end.is_good());
        results.is_complete = false;
        results.store(&folder.path("rtt")).unwrap();
        let end = BenchEnd::read(&folder.path("rtt"), false, "signal: 9 (SIGKILL)");
        assert_eq!(end, BenchEnd::Failed("signal: 9 (SIGKILL)".to_owned()));
    }

    #[test]
    fn without_results_a_benchmark_is_skipped_or_failed_with_the_reason() {
        let folder = TestFolder::new();
        let read = |output: &str, is_skipped| {
            fs::write(folder.path(OUTPUT), output).unwrap();
            BenchEnd::read(&folder.path(""), is_skipped, "exit status: 101")
        };
        let skipped = read("skipped: no player\n", true);
        assert_eq!(skipped, BenchEnd::Skipped("no player".to_owned()));
        let failed = read("skipped: a part\npanicked at x\nno Python\nstack\n 1: x\n\n", false);
        assert_eq!(failed, BenchEnd::Failed("exit status: 101: no Python".to_owned()));
        let error = read("measuring\nerror: no room\n\n", false);
        assert_eq!(error, BenchEnd::Failed("exit status: 101: error: no room".to_owned()));
        assert_eq!(read("", false), BenchEnd::Failed("exit status: 101".to_owned()));
        let entry = |bench: &str, end| SequenceEntry { bench: bench.to_owned(), seconds: 1.0, end };
        let text = SequenceEntry::to_markdown(&[entry("rtt", skipped), entry("replay", failed)]);
        let rows =
            "- rtt, 1 s: skipped: no player\n- replay, 1 s: FAILED: exit status: 101: no Python\n";
        assert!(text.ends_with(rows), "{text}");
    }
}
