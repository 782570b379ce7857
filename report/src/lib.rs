//! The results of a run, for people: read from the folder that a replay or a live run wrote to,
//! compared with those of another, and made a page of.
//!
//! - [`Page`] is `report.html`: what a lambda did, when, why, what it missed and what it cost, in
//!   one file that needs nothing else.
//! - [`Diff`] is what differs between two runs, decision by decision.
//! - [`Decisions`], [`JsonLines`] and [`clips`] read a file line by line; [`words`] has the form of
//!   times, sizes and scores.
//!
//! Only the folders that a caller names are read, and nothing is written or printed: a caller
//! stores the page and shows the differences. The files may have been written by others. Lines are
//! read one by one, each list has a bound and says what is beyond it, links and pipes are refused.
//!
//! Instants are in ns as the drive has them, `_ns` in their name; `t`, `from` and `to` are in s
//! after the start of the drive.

mod diff;
mod page;
mod results;
mod run_summary;
pub mod words;

pub use diff::{Change, Cost, Diff, DiffError, Difference, Is, Of, Side, Tally};
pub use page::Page;
pub use results::{Decisions, JsonLines, ResultsError, clips};
pub use run_summary::{FileError, OutputError};
