//! `gleaner report OUT`: writes the report page, which `gleaner-report` makes, to
//! `OUT/report.html`, and that of each separate drive into the folder of its results.

use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, visible, write_atomically};
use gleaner_report::{Diff, ReportPage};

use crate::args::ReportArgs;
use crate::output::print;
use crate::separate;

pub(crate) const NAME: &str = "report.html";

pub(crate) fn run(args: &ReportArgs) -> Result<Exit, Failure> {
    let mut folders = separate::result_folders(&args.out);
    if folders.is_empty() {
        // Its error names what is missing.
        folders.push(args.out.clone());
    }
    let mut first = Exit::Ok;
    for folder in folders {
        match write(&folder) {
            Ok(page) => print(&format!("{}\n", visible(&page.to_string_lossy())))?,
            Err(failure) => {
                eprintln!("{failure}");
                first = if first == Exit::Ok { failure.exit } else { first };
            }
        }
    }
    Ok(first)
}

pub(crate) fn write(out: &Path) -> Result<PathBuf, Failure> {
    save(&ReportPage::of(out)?, out.join(NAME))
}

/// Writes a page about two runs and their differences to `path`.
pub(crate) fn write_both(a: &Path, b: &Path, diff: Diff, path: &Path) -> Result<PathBuf, Failure> {
    save(&ReportPage::of_both(a, b, diff)?, path.to_owned())
}

fn save(page: &ReportPage, path: PathBuf) -> Result<PathBuf, Failure> {
    match write_atomically(&path, page.to_html().as_bytes()) {
        Ok(()) => Ok(path),
        Err(error) => {
            let failure = Failure::caused_by(
                Exit::Internal,
                format!("cannot write the report `{}`", path.display()),
                &error,
            );
            Err(failure.with_help(
                "check that the folder exists and is writable, and that its disk has room",
            ))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_results_no_page_is_written() {
        let out = tempfile::tempdir().unwrap();
        std::fs::write(out.path().join("summary.json"), "{}").unwrap();
        assert_eq!(write(out.path()).unwrap_err().exit, Exit::Usage);
        assert!(!out.path().join(NAME).exists());
    }
}
