//! Builds in steps compile nothing twice. Cargo selects the features of a dependency by all
//! packages that a command names, and compiles it again for other features.

use std::collections::{BTreeMap, BTreeSet};
use std::env;
use std::path::Path;
use std::process::Command;

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
    // Between two trees is an empty line.
    for (name, features) in lines.lines().filter_map(|line| line.split_once('\t')) {
        let features = features.trim_end_matches(" (*)").to_owned();
        packages.entry(name.to_owned()).or_default().insert(features);
    }
    packages
}

/// Fails if a package of `some` has features that it does not have in `cargo test`.
#[track_caller]
fn assert_reused(some: &BTreeMap<String, BTreeSet<String>>) {
    let all = packages("normal,build,dev", &[]);
    let others = |name, sets: &BTreeSet<_>| Some(sets.difference(all.get(name)?).count() > 0);
    let again: Vec<_> =
        some.iter().filter(|(name, sets)| others(*name, sets) != Some(false)).collect();
    assert!(again.is_empty(), "with other features in `cargo test`: {again:#?}");
}

#[test]
fn tests_reuse_the_build_of_the_programs() {
    // So the Python extension is built alone.
    let programs = packages("normal,build", &["gleaner-python", "gleaner-features"]);
    assert!(programs.len() > 100, "{}", programs.len());
    assert_reused(&programs);
}
