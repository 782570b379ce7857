//! Sets up `.venv`: Python with numpy for Python lambdas, and for tests and benches mypy, which
//! checks the SDK's types, and other readers of clips. Versions are not pinned: the newest ones for
//! this Python are tested, as users have them. Only mypy has an upper bound, since a newer one may
//! report new errors in old code.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::Failure;
use gleaner_base::programs::InstalledPrograms;

use crate::checkout::Checkout;
use crate::steps::{self, cannot, download, run, succeeds};

/// Packages for lambdas: name in pip, and name of the module.
const PACKAGES: [(&str, &str); 1] = [("numpy", "numpy")];

/// Packages for tests and benches: types, readers, pictures in `gleaner.testing`, tests of lambdas,
/// notebooks, and the check of the description of the cloud's API.
const FOR_TESTS: [(&str, &str); 10] = [
    ("mypy<2.5", "mypy"),
    ("mcap", "mcap"),
    ("mcap-ros2-support", "mcap_ros2"),
    ("rosbags", "rosbags"),
    ("pillow", "PIL"),
    ("pytest", "pytest"),
    ("nbclient", "nbclient"),
    ("ipykernel", "ipykernel"),
    ("matplotlib", "matplotlib"),
    ("openapi-spec-validator", "openapi_spec_validator"),
];

/// File in an environment of its own with its packages, written when all are installed. Those of
/// another version of this program may be others.
const LIST: &str = "packages.txt";

/// The way out of a download that failed.
pub(crate) const NETWORK: &str = "check the network, or configure a mirror for pip";

/// Creates or completes the environment. It is created again if its Python does not run, because
/// the system's Python was removed.
pub(crate) fn set_up(checkout: &Checkout) -> Result<(), Failure> {
    if has(checkout, &PACKAGES) {
        return Ok(());
    }
    if !succeeds(&mut python(checkout, "import pip")) {
        let folder = checkout.path(".venv");
        if folder.exists() {
            println!("creating it again: its Python does not run");
        }
        make(checkout, &folder)?;
    }
    fetch(checkout, &PACKAGES)
}

/// Adds the packages for tests and benches to the environment.
pub(crate) fn set_up_for_tests(checkout: &Checkout) -> Result<(), Failure> {
    if has(checkout, &FOR_TESTS) { Ok(()) } else { fetch(checkout, &FOR_TESTS) }
}

/// Makes an environment of its own in `folder`, with packages that lambdas do not need, some of
/// them with versions. Returns its Python.
pub(crate) fn apart(
    checkout: &Checkout,
    folder: &Path,
    packages: &[&str],
) -> Result<PathBuf, Failure> {
    let python = folder.join("bin/python3");
    if !is_made_of(checkout, folder, packages) {
        // What is there may serve, without a network.
        if !has_pip(checkout, folder) {
            make(checkout, folder)?;
        }
        pip(checkout.command(&python), packages, NETWORK)?;
        let list = folder.join(LIST);
        fs::write(&list, packages.join("\n")).map_err(|error| cannot("write", &list, &error))?;
    }
    Ok(python)
}

/// Returns whether the environment in `folder` runs, and was completed with just these packages.
fn is_made_of(checkout: &Checkout, folder: &Path, packages: &[&str]) -> bool {
    let list = fs::read_to_string(folder.join(LIST));
    list.is_ok_and(|list| list == packages.join("\n")) && has_pip(checkout, folder)
}

fn has_pip(checkout: &Checkout, folder: &Path) -> bool {
    let mut python = checkout.command(folder.join("bin/python3"));
    succeeds(python.args(["-I", "-c", "import pip"]))
}

/// Makes an environment without packages, in place of that in `folder`.
fn make(checkout: &Checkout, folder: &Path) -> Result<(), Failure> {
    steps::remove_folder(folder)?;
    // Found as for a lambda: that of `.venv` comes first, unless it is what is made again.
    let interpreter = InstalledPrograms::find()?.python(None)?;
    println!("created by {}", interpreter.display());
    let mut make = checkout.command(interpreter);
    make.args(["-m", "venv"]).arg(folder);
    run(&mut make, "set GLEANER_PYTHON to a Python 3.9 or newer with venv and ensurepip")
}

/// A command that runs `code` with the environment's Python.
fn python(checkout: &Checkout, code: &str) -> Command {
    let mut python = checkout.command(checkout.python());
    python.args(["-I", "-c", code]);
    python
}

fn has(checkout: &Checkout, packages: &[(&str, &str)]) -> bool {
    let modules: Vec<_> = packages.iter().map(|(_, module)| *module).collect();
    succeeds(&mut python(checkout, &format!("import {}", modules.join(", "))))
}

fn fetch(checkout: &Checkout, packages: &[(&str, &str)]) -> Result<(), Failure> {
    let packages: Vec<_> = packages.iter().map(|(package, _)| *package).collect();
    pip(checkout.command(checkout.python()), &packages, NETWORK)
}

/// Installs packages with the pip of `python`. `help` is for the error message.
pub(crate) fn pip(mut python: Command, packages: &[&str], help: &str) -> Result<(), Failure> {
    python.args(["-m", "pip", "install", "--disable-pip-version-check", "-q"]).args(packages);
    download(&mut python, &format!("pip fetches {}: {help}", packages.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn an_environment_of_other_versions_is_made_again() {
        let folder = TestFolder::new();
        let checkout = Checkout::with_cargo(folder.root().to_owned(), "cargo".into());
        let is_made_of = |packages: &[&str]| is_made_of(&checkout, folder.root(), packages);
        folder.write_program("bin/python3", "#!/bin/sh\nexit 0\n");
        // pip was interrupted.
        assert!(!is_made_of(&["onnx==1.23.2", "numpy"]));
        folder.write(LIST, "onnx==1.23.2\nnumpy");
        assert!(is_made_of(&["onnx==1.23.2", "numpy"]));
        assert!(!is_made_of(&["onnx==1.24.0", "numpy"]));
        folder.write_program("bin/python3", "#!/bin/sh\nexit 1\n");
        assert!(!is_made_of(&["onnx==1.23.2", "numpy"]));
    }
}
