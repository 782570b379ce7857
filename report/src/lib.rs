//! Reads the results of a replay or a live run, compares two runs, and makes the report page.
//!
//! - [`ReportPage`] is `report.html`: decisions, their causes, losses and cost, in one
//!   self-contained file.
//! - [`Diff`] holds the differences between two runs, decision by decision.
//! - [`Decisions`], [`JsonLines`] and [`clips`] read a file line by line; [`mod@format`] formats
//!   times, sizes and scores.
//!
//! This crate reads only the folders that the caller names, and writes and prints nothing: the
//! caller stores the page and shows the differences. The files are untrusted. Lines are read one by
//! one, each list is bounded and counts its omitted items, links and pipes are refused.
//!
//! Names ending in `_ns` are instants in ns as in the drive; `t`, `from` and `to` are in s after
//! the start of the drive.

mod diff;
pub mod format;
mod page;
mod results;
mod run_summary;
#[cfg(test)]
mod tests;

pub use diff::{
    ChangeCounts, ChangeKind, ComparedRun, Cost, Diff, DiffError, Difference, DifferenceKind,
    ValueChange,
};
pub use page::ReportPage;
pub use results::{Decisions, JsonLines, ResultsError, clips};
pub use run_summary::{FileError, OutputError};
