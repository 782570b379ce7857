//! Sets up what every command needs. Each step does nothing if nothing is missing.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::Failure;

use crate::checkout::Checkout;
use crate::steps::{self, Steps};
use crate::venv;

/// The number of steps that [`run`] takes.
pub(crate) const STEPS: usize = 4;

/// The programs that a replay needs, besides the extension module for Python.
const FOR_REPLAYS: [&str; 4] = ["gleaner", "gleaner-compile", "gleaner-runtime", "gleaner-shim"];

/// The programs that a vehicle needs besides.
const ON_VEHICLES: [&str; 5] = [
    "gleaner-inference",
    "gleaner-ingress",
    "gleaner-orchestrator",
    "gleaner-recorder",
    "gleaner-supervisor",
];

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
    "gleaner-sandbox",
    "gleaner-supervisor",
];

/// Features of the programs that cargo does not select by default.
pub(crate) const SCALED: &str = "--features=gleaner-cloud/scaled";

/// Sets up the wasm target, `.venv`, all programs, and these lambdas.
pub(crate) fn run(
    checkout: &Checkout,
    steps: &mut Steps,
    lambdas: &[PathBuf],
) -> Result<(), Failure> {
    run_with(checkout, steps, lambdas, programs)
}

/// Sets up the same, with the programs that `programs` builds.
pub(crate) fn run_with(
    checkout: &Checkout,
    steps: &mut Steps,
    lambdas: &[PathBuf],
    programs: impl FnOnce(&Checkout) -> Result<(), Failure>,
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
    let libraries = rustc(checkout, &["--print", "target-libdir", "--target", target])?;
    if Path::new(&libraries).is_dir() {
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

/// Returns the text that the compiler prints.
pub(crate) fn rustc(checkout: &Checkout, arguments: &[&str]) -> Result<String, Failure> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let mut rustc = checkout.command(rustc);
    Ok(steps::output(rustc.args(arguments), "install Rust with rustup")?.trim().to_owned())
}

/// Builds all programs in one call, even those that a command does not need: shared crates then
/// have the features of `cargo test`, and nothing heavy compiles twice.
pub(crate) fn programs(checkout: &Checkout) -> Result<(), Failure> {
    build(checkout, &PROGRAMS, &[])
}

/// Builds what a replay needs, with the features of [`programs`].
pub(crate) fn replay_programs(checkout: &Checkout) -> Result<(), Failure> {
    build(checkout, &PROGRAMS, &FOR_REPLAYS)?;
    // Only a library can be an extension module, and cargo builds those of all named packages.
    build(checkout, &["gleaner-python", "gleaner-features"], &["--lib"])
}

/// Builds what a vehicle needs besides, with the features of [`programs`].
pub(crate) fn vehicle_programs(checkout: &Checkout) -> Result<(), Failure> {
    build(checkout, &PROGRAMS, &ON_VEHICLES)
}

/// Builds programs of these packages: those that are named, or all. `--lib` stands for libraries.
fn build(checkout: &Checkout, packages: &[&str], programs: &[&str]) -> Result<(), Failure> {
    let mut build = checkout.cargo();
    build
        .args(["build", "--release"])
        .args(packages.iter().flat_map(|package| ["--package", package]));
    if packages.contains(&"gleaner-cloud") {
        build.arg(SCALED);
    }
    for program in programs {
        if program.starts_with("--") {
            build.arg(program)
        } else {
            build.args(["--bin", program])
        };
    }
    steps::run(
        &mut build,
        "if a linker or a C compiler is missing, install one (`cc`); else see the first error \
         above",
    )
}

/// Builds these programs. No package is named: cargo selects features by the named packages, and
/// other features would compile dependencies twice.
pub(crate) fn binaries(checkout: &Checkout, names: &[&str]) -> Result<(), Failure> {
    build(checkout, &[], names)
}

/// Returns the command that tests the bindings of the Rust SDK, which a test in `test-support`
/// generates and compares; with `GLEANER_BLESS` it writes them.
pub(crate) fn test_bindings(checkout: &Checkout) -> Command {
    let mut test = checkout.cargo();
    // The generator runs for a second, so it is not optimized.
    test.args(["test", "--profile", "xtask", "--package", "gleaner-test-support"]);
    test.args(["--features", "generator"]);
    test
}

pub(crate) fn build_lambdas(checkout: &Checkout, folders: &[PathBuf]) -> Result<(), Failure> {
    for lambda in folders {
        let mut build = checkout.command(checkout.program("gleaner"));
        build.arg("build").arg(lambda);
        steps::run(&mut build, "see the error above")?;
    }
    Ok(())
}
