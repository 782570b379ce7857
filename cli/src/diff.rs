//! `gleaner diff OUT1 OUT2`: shows what differs between two runs. What is compared, and how, is
//! decided in `gleaner-report`.

use gleaner_base::{Exit, Failure};
use gleaner_report::Diff;

use crate::args::DiffArgs;
use crate::report;
use crate::say::say;
use crate::show::{self, Paint, json_line};

/// Compares, and shows what differs: ends with 0 if the decisions are the same, with 4 if not.
pub(crate) fn run(args: &DiffArgs) -> Result<Exit, Failure> {
    let diff = Diff::between(&args.a, &args.b)?;
    let exit = if diff.same { Exit::Ok } else { Exit::Differs };
    say(&if args.json { json_line(&diff) } else { show::diff(&diff, Paint::of_stdout()) })?;
    // Only then: a page that cannot be written must not cost what was found.
    if let Some(path) = &args.report {
        let path = report::write_both(&args.a, &args.b, diff, path)?;
        if !args.json {
            say(&format!("  report: {}\n", path.display()))?;
        }
    }
    Ok(exit)
}
