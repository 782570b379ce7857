//! `gleaner diff OUT1 OUT2`: prints the differences between two runs, which `gleaner-report` finds.

use gleaner_base::{Exit, Failure};
use gleaner_report::Diff;

use crate::args::DiffArgs;
use crate::output::{print, show};
use crate::render::{self, Paint};
use crate::report;

/// Compares two runs and prints the differences. Exits with 0 if the decisions are identical, else
/// with 4.
pub(crate) fn run(args: &DiffArgs) -> Result<Exit, Failure> {
    let diff = Diff::between(&args.a, &args.b)?;
    let exit = if diff.identical { Exit::Ok } else { Exit::Differs };
    show(args.json, &diff, |diff| render::diff(diff, Paint::of_stdout()))?;
    // Last, since the differences are printed even if the page cannot be written.
    if let Some(path) = &args.report {
        let path = report::write_both(&args.a, &args.b, diff, path)?;
        if !args.json {
            print(&format!("  report: {}\n", path.display()))?;
        }
    }
    Ok(exit)
}
