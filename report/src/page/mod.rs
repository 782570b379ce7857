//! `OUT/report.html`: what a lambda did, when, why, what it missed and what it cost, on one page
//! that needs nothing else.
//!
//! `gather` and `marks` read what the files say line by line, within bounds; `html` makes a file of
//! it. Nothing of the drive is read, and nothing outside of the output. The script of the page is
//! in `report/assets/page`.

mod density;
mod gather;
mod html;
mod marks;
mod model;
mod pictures;
#[cfg(test)]
pub(crate) mod tests;

use std::path::Path;

use serde::Serialize;

use crate::diff::Diff;
use crate::run_summary::OutputError;
use crate::words::seconds;

use model::Run;

/// The data of a page about one run, or about two that are compared.
#[derive(Debug, Serialize)]
pub struct Page {
    /// Which gleaner made it.
    made_by: String,
    /// One, or two that are compared.
    runs: Vec<Run>,
    diff: Option<Diff>,
}

impl Page {
    /// Gathers the page about the run that wrote to the folder `out`. What cannot be used of a file
    /// is left out, and the page says so.
    ///
    /// # Errors
    ///
    /// [`OutputError`] if `out` has no `summary.json` of ours, or holds a link or a pipe where a
    /// result belongs.
    pub fn of(out: &Path) -> Result<Page, OutputError> {
        Ok(Page::new(vec![gather::gather(out, 1, None)?], None))
    }

    /// Gathers the page about the runs in `a` and `b`, and what differs between them:
    /// [`Diff::between`] of the same folders. All times on it count from the start of the first
    /// run.
    ///
    /// # Errors
    ///
    /// As [`of`](Self::of).
    pub fn of_both(a: &Path, b: &Path, mut diff: Diff) -> Result<Page, OutputError> {
        let a = gather::gather(a, 2, None)?;
        let b = gather::gather(b, 2, Some(a.start_ns))?;
        for difference in &mut diff.differences {
            difference.t = seconds(difference.at_ns, a.start_ns);
        }
        Ok(Page::new(vec![a, b], Some(diff)))
    }

    /// The page as one file in UTF-8, of at most a few MiB: it loads nothing, and runs no script
    /// but its own, whatever the results say.
    pub fn to_html(&self) -> String {
        html::html(self)
    }

    fn new(runs: Vec<Run>, diff: Option<Diff>) -> Page {
        Page { made_by: format!("gleaner {}", env!("CARGO_PKG_VERSION")), runs, diff }
    }
}
