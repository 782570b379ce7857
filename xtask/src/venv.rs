//! `.venv`: Python with numpy, for Python lambdas; and for tests and benches mypy, which checks the
//! SDK's types, and the readers of others, by which tests read our clips. No version is pinned: the
//! newest that this Python takes, so that a user's environment is the one that is tested. But for
//! mypy, of which the newest may find new faults in old code: it has an upper bound.

use std::fs;
use std::process::Command;

use gleaner_base::{Exit, Failure};
use gleaner_parts::Parts;

use crate::checkout::Checkout;
use crate::steps::{run, succeeds};

/// What lambdas need: what pip calls it, and what Python does.
const PACKAGES: [(&str, &str); 1] = [("numpy", "numpy")];

/// What tests and benches need, too: types, readers, `gleaner.testing` on pictures, tests of
/// lambdas, and notebooks.
const FOR_TESTS: [(&str, &str); 9] = [
    ("mypy<2.5", "mypy"),
    ("mcap", "mcap"),
    ("mcap-ros2-support", "mcap_ros2"),
    ("rosbags", "rosbags"),
    ("pillow", "PIL"),
    ("pytest", "pytest"),
    ("nbclient", "nbclient"),
    ("ipykernel", "ipykernel"),
    ("matplotlib", "matplotlib"),
];

/// Makes the environment, or completes it. One whose Python does not run, since the system's Python
/// went, is made anew.
pub(crate) fn set_up(checkout: &Checkout) -> Result<(), Failure> {
    if has(checkout, &PACKAGES) {
        return Ok(());
    }
    if !succeeds(&mut python(checkout, "import pip")) {
        let folder = checkout.path(".venv");
        if folder.exists() {
            println!("making it anew: its Python does not run");
            fs::remove_dir_all(&folder).map_err(|error| {
                Failure::caused_by(
                    Exit::Internal,
                    format!("cannot remove `{}`", folder.display()),
                    &error,
                )
            })?;
        }
        // By the rule by which Python is found for a lambda; what is in `.venv` comes first, and
        // there is nothing.
        let interpreter = Parts::find()?.python(None)?;
        println!("made by {}", interpreter.display());
        let mut make = checkout.command(interpreter);
        make.args(["-m", "venv"]).arg(folder);
        run(&mut make, "set GLEANER_PYTHON to a Python 3.9 or newer that has venv and ensurepip")?;
    }
    fetch(checkout, &PACKAGES)
}

/// Adds what tests and benches need to the environment.
pub(crate) fn set_up_for_tests(checkout: &Checkout) -> Result<(), Failure> {
    if has(checkout, &FOR_TESTS) { Ok(()) } else { fetch(checkout, &FOR_TESTS) }
}

/// The environment's Python, which is to run `code`.
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
    pip(
        checkout.command(checkout.python()),
        &packages,
        "see that the network is there, or configure pip for a mirror",
    )
}

/// Has the pip of a `python` fetch packages. `help` is what else can be done.
pub(crate) fn pip(mut python: Command, packages: &[&str], help: &str) -> Result<(), Failure> {
    python.args(["-m", "pip", "install", "--disable-pip-version-check", "-q"]).args(packages);
    run(&mut python, &format!("pip fetches {}: {help}", packages.join(", ")))
}
