//! `OUT/report.html`: what a lambda did, when, why, what it missed and what it cost, on one page that needs nothing else.
//!
//! `told` reads what the files say as a whole, `gather` and `marks` what they say line by line, within bounds; `page` makes a file of it.
//! Nothing of the drive is read, and nothing outside of the output. The script of the page is in `cli/assets/report`.

mod density;
mod gather;
mod marks;
mod model;
mod page;
mod pictures;
mod told;

use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, write_whole};

use crate::args::ReportArgs;
use crate::diff::Diff;
use crate::results::seconds;
use crate::say::say;

pub(crate) use marks::cut;
pub(crate) use told::{Losses, TellError, Told, signals};

use model::Page;

/// The name of the page in the folder of the results.
pub(crate) const NAME: &str = "report.html";

/// `gleaner report OUT`.
pub(crate) fn run(args: &ReportArgs) -> Result<Exit, Failure> {
    let path = write(&args.out)?;
    say(&format!("{}\n", path.display()))?;
    Ok(Exit::Ok)
}

/// Writes the report of `out` into it.
pub(crate) fn write(out: &Path) -> Result<PathBuf, Failure> {
    let page = Page { made_by: made_by(), runs: vec![gather::gather(out, 1, None)?], diff: None };
    save(&page, out.join(NAME))
}

/// Writes a page about two runs, and what differs between them, to `path`. All of it counts from the start of the first.
pub(crate) fn write_both(a: &Path, b: &Path, mut diff: Diff, path: &Path) -> Result<PathBuf, Failure> {
    let a = gather::gather(a, 2, None)?;
    let b = gather::gather(b, 2, Some(a.start_ns))?;
    for difference in &mut diff.differences {
        difference.t = seconds(difference.at_ns, a.start_ns);
    }
    let runs = vec![a, b];
    save(&Page { made_by: made_by(), runs, diff: Some(diff) }, path.to_owned())
}

fn made_by() -> String {
    format!("gleaner {}", env!("CARGO_PKG_VERSION"))
}

fn save(page: &Page, path: PathBuf) -> Result<PathBuf, Failure> {
    match write_whole(&path, page::html(page).as_bytes()) {
        Ok(()) => Ok(path),
        Err(error) => {
            let failure =
                Failure::caused_by(Exit::Internal, format!("cannot write the report `{}`", path.display()), &error);
            Err(failure.with_help("make room, or choose a folder that you may write to"))
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
