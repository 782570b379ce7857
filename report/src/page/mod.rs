//! Makes `OUT/report.html`: decisions, their causes, losses and cost, on one self-contained page.
//!
//! `collect` and `events` read the result files line by line, within bounds; `html` renders the
//! page. Only the result folder is read, not the drive. The script of the page is in
//! `report/assets/page`.

mod collect;
mod density;
mod events;
mod html;
mod model;
mod pictures;
#[cfg(test)]
mod tests;

use std::path::Path;

use serde::Serialize;

use crate::diff::Diff;
use crate::format::seconds;
use crate::run_summary::OutputError;

use html::html;
use model::PageRun;

/// The data of a page about one run, or about two that are compared.
#[derive(Debug, Serialize)]
pub struct ReportPage {
    made_by: String,
    /// One run, or two that are compared.
    runs: Vec<PageRun>,
    diff: Option<Diff>,
}

impl ReportPage {
    /// Collects the page about the run in the folder `out`. Data that cannot be read is omitted
    /// with a note.
    ///
    /// # Errors
    ///
    /// [`OutputError`] if `out` has no valid `summary.json`, or a link or a pipe in place of a
    /// result file.
    pub fn of(out: &Path) -> Result<ReportPage, OutputError> {
        Ok(ReportPage::new(vec![collect::collect(out, 1, None)?], None))
    }

    /// Collects the page about the runs in `a` and `b`, and their differences `diff`, which are
    /// [`Diff::between`] the same folders. All times count from the start of the first run.
    ///
    /// # Errors
    ///
    /// As [`of`](Self::of).
    pub fn of_both(a: &Path, b: &Path, mut diff: Diff) -> Result<ReportPage, OutputError> {
        let a = collect::collect(a, 2, None)?;
        let b = collect::collect(b, 2, Some(a.start_ns))?;
        for difference in &mut diff.differences {
            difference.t = seconds(difference.at_ns, a.start_ns);
        }
        Ok(ReportPage::new(vec![a, b], Some(diff)))
    }

    /// Renders the page as one file in UTF-8, of at most a few MiB. It loads nothing, and runs no
    /// script but its own, whatever the results contain.
    pub fn to_html(&self) -> String {
        html(self)
    }

    fn new(runs: Vec<PageRun>, diff: Option<Diff>) -> ReportPage {
        ReportPage { made_by: format!("gleaner {}", env!("CARGO_PKG_VERSION")), runs, diff }
    }
}
