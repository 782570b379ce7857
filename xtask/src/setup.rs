//! Sets up what every command needs. Each step does nothing if nothing is missing.

use std::path::{Path, PathBuf};

use gleaner_base::Failure;

use crate::checkout::Checkout;
use crate::steps::{self, Steps};
use crate::venv;

/// The number of steps that [`run`] takes.
pub(crate) const STEPS: usize = 4;

/// Compilation target of Rust lambdas.
pub(crate) const TARGET: &str = "wasm32-wasip2";

/// The packages with installed programs: no benches, no tests, no lambdas.
pub(crate) const PROGRAMS: [&str; 11] = [
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

/// Sets up the wasm target, `.venv`, the programs, and these lambdas.
pub(crate) fn run(
    checkout: &Checkout,
    steps: &mut Steps,
    lambdas: &[PathBuf],
) -> Result<(), Failure> {
    steps.begin(&format!("compilation target {TARGET}"));
    target(checkout, TARGET)?;
    steps.begin("Python environment .venv with numpy");
    venv::set_up(checkout)?;
    steps.begin("programs (the first time this takes minutes)");
    programs(checkout)?;
    steps.begin(&format!("{} lambdas", lambdas.len()));
    build_lambdas(checkout, lambdas)
}

/// Installs Rust's libraries for `target`.
pub(crate) fn target(checkout: &Checkout, target: &str) -> Result<(), Failure> {
    // The compiler is queried, since it need not come from rustup.
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let mut rustc = checkout.command(rustc);
    rustc.args(["--print", "target-libdir", "--target", target]);
    let libraries = steps::output(&mut rustc, "install Rust with rustup")?;
    if Path::new(libraries.trim()).is_dir() {
        return Ok(());
    }
    let mut add = checkout.command("rustup");
    add.args(["target", "add", target]);
    let help = format!(
        "install the standard library for {target}: `rustup target add {target}`, or your system's \
         package"
    );
    steps::run(&mut add, &help)
}

/// Builds all programs in one call, even those that a command does not need: shared crates then
/// have the features of `cargo test`, and nothing heavy compiles twice.
pub(crate) fn programs(checkout: &Checkout) -> Result<(), Failure> {
    let mut build = checkout.cargo();
    build
        .args(["build", "--release"])
        .args(PROGRAMS.iter().flat_map(|package| ["--package", package]));
    steps::run(
        &mut build,
        "if a linker or a C compiler is missing, install one (`cc`); else see the first error \
         above",
    )
}

/// Builds a program that is not installed.
pub(crate) fn binary(checkout: &Checkout, name: &str) -> Result<(), Failure> {
    let mut build = checkout.cargo();
    // Only the binary is named: cargo selects features by the named packages, and other features
    // would compile dependencies twice.
    build.args(["build", "--release", "--bin", name]);
    steps::run(&mut build, "see the first error above")
}

/// Builds the lambdas in these folders.
pub(crate) fn build_lambdas(checkout: &Checkout, folders: &[PathBuf]) -> Result<(), Failure> {
    for lambda in folders {
        let mut build = checkout.command(checkout.program("gleaner"));
        build.arg("build").arg(lambda);
        steps::run(&mut build, "see the error above")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::env;
    use std::process::Command;

    use super::*;

    /// Each package that cargo builds for `selected`, with its features; `edges` are the kinds of
    /// dependencies that count.
    fn packages(edges: &str, selected: &[&str]) -> BTreeSet<String> {
        let cargo = env::var_os("CARGO").expect("cargo runs the tests");
        let mut tree = Command::new(cargo);
        tree.current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(".."));
        tree.args([
            "tree", "--locked", "--edges", edges, "--prefix", "none", "--format", "{p} {f}",
        ]);
        tree.args(selected.iter().flat_map(|package| ["--package", package]));
        let output = tree.output().expect("cargo starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let lines = String::from_utf8(output.stdout).expect("names are text");
        lines.lines().map(|line| line.trim_end_matches(" (*)").to_owned()).collect()
    }

    #[test]
    fn tests_reuse_the_build_of_the_programs() {
        let (programs, all) =
            (packages("normal,build", &PROGRAMS), packages("normal,build,dev", &[]));
        assert!(programs.len() > 100, "{}", programs.len());
        // Cargo selects features by what it builds: a feature that only a test enables rebuilds
        // everything that uses it.
        let again: Vec<_> = programs.difference(&all).collect();
        assert!(again.is_empty(), "with other features in `cargo test`: {again:#?}");
    }
}
