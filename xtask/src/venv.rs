//! `.venv`: Python with numpy, for Python lambdas; mypy, for the check of the SDK's types; and the readers of others, by which
//! tests read our clips. No version is pinned: the newest that this Python takes, so that a user's environment is the one that
//! is tested.

use std::fs;
use std::process::Command;

use gleaner_protocol::{Exit, Failure, Parts};

use crate::checkout::Checkout;
use crate::steps::{run, succeeds};

/// What pip calls each, and what Python does.
const PACKAGES: [(&str, &str); 5] = [
    ("numpy", "numpy"),
    ("mypy", "mypy"),
    ("mcap", "mcap"),
    ("mcap-ros2-support", "mcap_ros2"),
    ("rosbags", "rosbags"),
];

/// Makes the environment, or completes it. One whose Python does not run, since the system's Python went, is made anew.
pub(crate) fn set_up(checkout: &Checkout) -> Result<(), Failure> {
    let python = |code: &str| {
        let mut python = checkout.command(checkout.python());
        python.args(["-I", "-c", code]);
        python
    };
    if succeeds(&mut python(&format!("import {}", PACKAGES.map(|(_, module)| module).join(", ")))) {
        return Ok(());
    }
    if !succeeds(&mut python("import pip")) {
        let folder = checkout.path(".venv");
        if folder.exists() {
            println!("making it anew: its Python does not run");
            fs::remove_dir_all(&folder).map_err(|error| {
                Failure::caused_by(Exit::Internal, format!("cannot remove `{}`", folder.display()), &error)
            })?;
        }
        // By the rule by which Python is found for a lambda; what is in `.venv` comes first, and there is nothing.
        let interpreter = Parts::find()?.python(None)?;
        println!("made by {}", interpreter.display());
        let mut make = checkout.command(interpreter);
        make.args(["-m", "venv"]).arg(folder);
        run(&mut make, "set GLEANER_PYTHON to a Python 3.9 or newer that has venv and ensurepip")?;
    }
    let packages = PACKAGES.map(|(package, _)| package);
    pip(checkout.command(checkout.python()), &packages, "see that the network is there, or configure pip for a mirror")
}

/// Has the pip of a `python` fetch packages. `help` is what else can be done.
pub(crate) fn pip(mut python: Command, packages: &[&str], help: &str) -> Result<(), Failure> {
    python.args(["-m", "pip", "install", "--disable-pip-version-check", "-q"]).args(packages);
    run(&mut python, &format!("pip fetches {}: {help}", packages.join(", ")))
}
