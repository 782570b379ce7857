//! Builds in steps compile nothing twice. Cargo selects the features of a dependency by all
//! packages that a command names, and compiles it again for other features.

use std::collections::{BTreeMap, BTreeSet};
use std::env;
use std::path::Path;
use std::process::Command;

/// The packages with installed programs, as `xtask/src/setup.rs` builds them.
const PROGRAMS: [&str; 11] = [
    "gleaner-cli",
    "gleaner-cloud",
    "gleaner-compile",
    "gleaner-host",
    "gleaner-inference",
    "gleaner-ingress",
    "gleaner-orchestrator",
    "gleaner-python",
    "gleaner-recorder",
    "gleaner-shim",
    "gleaner-supervisor",
];

/// Each package that cargo builds for `selected`, with the sets of features that it is built with;
/// `edges` are the kinds of dependencies that count.
fn packages(edges: &str, selected: &[&str]) -> BTreeMap<String, BTreeSet<String>> {
    let cargo = env::var_os("CARGO").expect("cargo runs the tests");
    let mut tree = Command::new(cargo);
    tree.current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("../.."));
    tree.args(["tree", "--locked", "--edges", edges, "--prefix", "none", "--format", "{p}\t{f}"]);
    tree.args(selected.iter().flat_map(|package| ["--package", package]));
    let output = tree.output().expect("cargo starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let lines = String::from_utf8(output.stdout).expect("names are text");
    let mut packages = BTreeMap::<_, BTreeSet<_>>::new();
    for line in lines.lines() {
        let (name, features) = line.split_once('\t').expect("the format has a tab");
        let features = features.trim_end_matches(" (*)").to_owned();
        packages.entry(name.to_owned()).or_default().insert(features);
    }
    packages
}

/// Fails if a package in `some` has features that it does not have in `all`.
fn assert_reused(some: &BTreeMap<String, BTreeSet<String>>, names: &BTreeSet<&String>) {
    let all = packages("normal,build,dev", &[]);
    let again = some.iter().filter(|(name, _)| names.contains(name));
    let again: Vec<_> = again
        .filter_map(|(name, sets)| sets.difference(all.get(name)?).next().map(|it| (name, it)))
        .collect();
    assert!(again.is_empty(), "with other features in `cargo test`: {again:#?}");
}

#[test]
fn tests_reuse_the_build_of_the_programs() {
    let programs = packages("normal,build", &PROGRAMS);
    assert!(programs.len() > 100, "{}", programs.len());
    assert_reused(&programs, &programs.keys().collect());
}

#[test]
fn the_python_extension_has_the_features_of_all_programs() {
    let extension = packages("normal,build", &["gleaner-python"]);
    let with_features = packages("normal,build", &["gleaner-python", "gleaner-features"]);
    assert!(extension.len() > 100, "{}", extension.len());
    assert_reused(&with_features, &extension.keys().collect());
}
