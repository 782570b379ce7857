//! Sets up `.venv`: Python with numpy for Python lambdas, and for tests and benches mypy, which
//! checks the SDK's types, and other readers of clips. Versions are not pinned: the newest ones for
//! this Python are tested, as users have them. Only mypy has an upper bound, since a newer one may
//! report new errors in old code.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};
use gleaner_parts::Parts;

use crate::checkout::Checkout;
use crate::steps::{download, run, succeeds};

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
            fs::remove_dir_all(&folder).map_err(|error| {
                Failure::caused_by(
                    Exit::Internal,
                    format!("cannot remove `{}`", folder.display()),
                    &error,
                )
            })?;
        }
        // Found as for a lambda. `.venv` would come first, but does not exist here.
        let interpreter = Parts::find()?.python(None)?;
        println!("created by {}", interpreter.display());
        let mut make = checkout.command(interpreter);
        make.args(["-m", "venv"]).arg(folder);
        run(&mut make, "set GLEANER_PYTHON to a Python 3.9 or newer with venv and ensurepip")?;
    }
    fetch(checkout, &PACKAGES)
}

/// Adds the packages for tests and benches to the environment.
pub(crate) fn set_up_for_tests(checkout: &Checkout) -> Result<(), Failure> {
    if has(checkout, &FOR_TESTS) { Ok(()) } else { fetch(checkout, &FOR_TESTS) }
}

/// Makes an environment of its own in `folder`, with packages that lambdas do not need: name in
/// pip, and name of the module. Returns its Python.
pub(crate) fn apart(
    checkout: &Checkout,
    folder: &Path,
    packages: &[(&str, &str)],
) -> Result<PathBuf, Failure> {
    let python = folder.join("bin/python3");
    let modules: Vec<_> = packages.iter().map(|(_, module)| *module).collect();
    let import = format!("import {}", modules.join(", "));
    if !succeeds(checkout.command(&python).args(["-I", "-c", &import])) {
        let mut make = checkout.command(Parts::find()?.python(None)?);
        make.args(["-m", "venv", "--clear"]).arg(folder);
        run(&mut make, "set GLEANER_PYTHON to a Python 3.9 or newer with venv and ensurepip")?;
        let packages: Vec<_> = packages.iter().map(|(package, _)| *package).collect();
        pip(checkout.command(&python), &packages, NETWORK)?;
    }
    Ok(python)
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
