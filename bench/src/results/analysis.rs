//! Starts `bench/analysis`, which makes tables, figures and pages of results.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};
use gleaner_tests::root;

/// The Python of scripts: that of `GLEANER_PYTHON`, of the checkout, or of the system.
pub fn python() -> PathBuf {
    let of_checkout = root().join(".venv/bin/python3");
    match std::env::var_os("GLEANER_PYTHON") {
        Some(python) => python.into(),
        None if of_checkout.is_file() => of_checkout,
        None => "python3".into(),
    }
}

/// Makes the tables, the figures and the page of the results in `folder`, beside them, and prints
/// the tables.
///
/// # Errors
///
/// The reason why there are none, with what to install.
pub fn render(folder: &Path) -> Result<(), Failure> {
    analyse(&["render".as_ref(), "--print".as_ref(), folder.as_os_str()])?;
    println!("\nresults and page: {}", folder.display());
    Ok(())
}

/// Prints a comparison of `b` with `a`, each a folder or file of results, or a folder of runs.
///
/// # Errors
///
/// The reason why there is none.
pub fn compare(a: &Path, b: &Path) -> Result<(), Failure> {
    analyse(&["compare".as_ref(), a.as_os_str(), b.as_os_str()])
}

fn analyse(arguments: &[&OsStr]) -> Result<(), Failure> {
    let python = python();
    let what = format!("cannot analyse the results by `{}`", python.display());
    let status = Command::new(python).arg(root().join("bench/analysis")).args(arguments).status();
    let status = status.map_err(|error| {
        Failure::caused_by(Exit::Internal, what.clone(), &error)
            .with_help("name a Python 3 with numpy and matplotlib: GLEANER_PYTHON=PATH")
    })?;
    match status.code() {
        Some(0) => Ok(()),
        code => {
            let exit = if code == Some(2) { Exit::Usage } else { Exit::Internal };
            // The program has named the cause and the way out.
            Err(Failure::new(exit, what).with_help("see the message above"))
        }
    }
}
