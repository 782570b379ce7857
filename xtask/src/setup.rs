//! What every command needs first. Each step looks first, and does nothing where nothing is missing.

use std::path::{Path, PathBuf};

use gleaner_base::Failure;

use crate::checkout::Checkout;
use crate::steps::{self, Steps};
use crate::venv;

/// The number of steps that [`run`] takes.
pub(crate) const STEPS: usize = 4;

/// What lambdas in Rust are compiled for.
pub(crate) const TARGET: &str = "wasm32-wasip2";

/// Sets up: the wasm target, `.venv`, all programs, the lambdas in `families`.
pub(crate) fn run(checkout: &Checkout, steps: &mut Steps, families: &[&str]) -> Result<(), Failure> {
    steps.begin(&format!("compilation target {TARGET}"));
    target(checkout, TARGET)?;
    steps.begin("Python environment .venv with numpy, mypy and readers of MCAP");
    venv::set_up(checkout)?;
    steps.begin("programs (the first time this takes minutes)");
    programs(checkout)?;
    steps.begin(&format!("lambdas in {}", families.join(", ")));
    lambdas(checkout, &checkout.lambdas(families))
}

/// Adds the libraries of Rust for `target`.
pub(crate) fn target(checkout: &Checkout, target: &str) -> Result<(), Failure> {
    // Asked of the compiler: it need not come from rustup.
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let mut rustc = checkout.command(rustc);
    rustc.args(["--print", "target-libdir", "--target", target]);
    let libraries = steps::output(&mut rustc, "install Rust with rustup")?;
    if Path::new(libraries.trim()).is_dir() {
        return Ok(());
    }
    let mut add = checkout.command("rustup");
    add.args(["target", "add", target]);
    let help =
        format!("install the standard library for {target}: `rustup target add {target}`, or your system's package");
    steps::run(&mut add, &help)
}

/// All in one call, as each test run needs them: features of shared crates are then the same everywhere, and nothing
/// heavy compiles twice.
pub(crate) fn programs(checkout: &Checkout) -> Result<(), Failure> {
    let mut build = checkout.cargo();
    build.args(["build", "--release"]);
    steps::run(&mut build, "if a linker or a C compiler is missing, install one (`cc`); else see the first error above")
}

/// Builds the lambdas in these folders.
pub(crate) fn lambdas(checkout: &Checkout, folders: &[PathBuf]) -> Result<(), Failure> {
    for lambda in folders {
        let mut build = checkout.command(checkout.program("gleaner"));
        build.arg("build").arg(lambda);
        steps::run(&mut build, "see the error above")?;
    }
    Ok(())
}
