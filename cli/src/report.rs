//! `gleaner report OUT`: writes the page about a run to `OUT/report.html`. What is on it is decided
//! in `gleaner-report`.

use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, write_whole};
use gleaner_report::{Diff, Page};

use crate::args::ReportArgs;
use crate::say::say;

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
    save(&Page::of(out)?, out.join(NAME))
}

/// Writes a page about two runs, and what differs between them, to `path`.
pub(crate) fn write_both(a: &Path, b: &Path, diff: Diff, path: &Path) -> Result<PathBuf, Failure> {
    save(&Page::of_both(a, b, diff)?, path.to_owned())
}

fn save(page: &Page, path: PathBuf) -> Result<PathBuf, Failure> {
    match write_whole(&path, page.to_html().as_bytes()) {
        Ok(()) => Ok(path),
        Err(error) => {
            let failure = Failure::caused_by(
                Exit::Internal,
                format!("cannot write the report `{}`", path.display()),
                &error,
            );
            Err(failure.with_help("make room, or choose a folder that you may write to"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_there_are_no_results_no_page_is_written() {
        let out = tempfile::tempdir().unwrap();
        std::fs::write(out.path().join("summary.json"), "{}").unwrap();
        assert_eq!(write(out.path()).unwrap_err().exit, Exit::Usage);
        assert!(!out.path().join(NAME).exists());
    }
}
