//! `gleaner new`: what it makes passes its test, builds, and finds the brakings of the sample drive. Nothing is fetched.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_protocol::Summary;
use gleaner_tests::{Folder, program, root, sample_drive};

/// A new lambda.
fn new(folder: &Folder, kind: &str) -> PathBuf {
    let lambda = folder.path().join("pot-hole");
    done(gleaner(folder.path()).args(["new", "pot-hole", "--kind", kind]));
    lambda
}

fn gleaner(at: &Path) -> Command {
    let mut gleaner = Command::new(program("gleaner"));
    gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache")).current_dir(at);
    // Its lock file names the versions of this workspace, which are here.
    gleaner.env("CARGO_NET_OFFLINE", "true").env("CARGO_TARGET_DIR", root().join("target/test-new"));
    gleaner
}

/// What it printed.
fn done(command: &mut Command) -> String {
    let output = command.output().expect("the program starts");
    let [out, error] = [output.stdout, output.stderr].map(|said| String::from_utf8_lossy(&said).into_owned());
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{error}", output.status);
    out
}

fn builds_and_finds_brakings(lambda: &Path) {
    done(gleaner(lambda).args(["build", "."]));
    let mut replay = gleaner(lambda);
    replay.args(["replay", ".", "--json", "--set", "brake_mps2=-1.4"]).arg(sample_drive());
    let summary: Summary = serde_json::from_str(&done(&mut replay)).expect("a summary");
    assert_eq!((summary.lambda.as_str(), summary.triggers, summary.faults), ("pot-hole", 3, 0));
}

#[test]
fn a_new_lambda_in_rust_passes_its_test_builds_and_finds_something() {
    let folder = Folder::new();
    let lambda = new(&folder, "rust");
    let mut test = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    test.args(["test", "--offline"]).env("CARGO_TARGET_DIR", root().join("target/test-new")).current_dir(&lambda);
    assert!(done(&mut test).contains("4 passed"));
    builds_and_finds_brakings(&lambda);
    done(gleaner(&lambda).args(["new", "--update", "."]));
    done(gleaner(&lambda).args(["build", "."]));
}

#[test]
fn a_new_lambda_in_python_passes_its_test_builds_and_finds_something() {
    let folder = Folder::new();
    let lambda = new(&folder, "python");
    let python = std::env::var_os("GLEANER_PYTHON").unwrap_or_else(|| root().join(".venv/bin/python3").into());
    let mut test = Command::new(python);
    test.args(["-m", "pytest", "-q"]).current_dir(&lambda);
    assert!(done(&mut test).contains("2 passed"));
    builds_and_finds_brakings(&lambda);
}
