//! `cargo xtask aarch64`: builds the programs of an ARM vehicle, and checks that lambdas decide
//! there as they do here: every decision of the same replays, bit for bit, and its fuel.
//!
//! The ARM programs run in qemu's user mode, which emulates the processor but uses this machine's
//! kernel. So this tests neither speed nor isolation: qemu supports neither Landlock nor seccomp,
//! and the programs report these layers as missing. qemu also lacks a system call that
//! `gleaner-shim` needs to start, so that program is built but not run: this machine's shim is used
//! instead.

mod tools;

use std::env;
use std::path::PathBuf;
use std::process::Command;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::setup;
use crate::steps::{self, Steps};
pub(crate) use tools::{TARGET, Tools};

/// The replays, and their comparison.
const REPLAYS: &str = include_str!("replays.sh");

/// The lambdas that are replayed.
const LAMBDAS: [&str; 6] = [
    "examples/brake-dark/rust",
    "examples/hello/rust",
    "examples/yolo-detector/rust",
    "tests/lambdas/kernels/rust",
    "tests/lambdas/misbehave/rust",
    "tests/lambdas/probe/rust",
];

pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    if env::consts::ARCH == "aarch64" {
        return Err(Failure::new(Exit::Usage, "this machine is itself an aarch64")
            .with_help("run `cargo xtask demo`"));
    }
    let mut steps = Steps::of(4);
    steps.begin(&format!("cross compiler, emulator and compilation target {TARGET}"));
    let tools = Tools::find(checkout)?;
    let emulator = tools::emulator(checkout)?;
    steps.begin("programs and lambdas for this machine (the first time this takes minutes)");
    setup::target(checkout, setup::TARGET)?;
    setup::programs(checkout)?;
    setup::build_lambdas(checkout, &LAMBDAS.map(PathBuf::from))?;
    steps.begin(&format!("programs for {TARGET} (the first time this takes minutes)"));
    let built = build(&mut tools.cargo(checkout), checkout, &[])?;
    println!("built {}", built.display());
    steps.begin("replays, each on both processors");
    let mut replays = checkout.command("bash");
    replays.args(["-c", REPLAYS, "replays"]).arg(checkout.target().join("release")).arg(built);
    replays.arg(emulator).arg(tools.libraries);
    steps::run_script(&mut replays)
}

/// Builds the programs of packages, and those of the packages `others` of cargo, of which one is
/// the player; returns their folder.
pub(crate) fn programs(checkout: &Checkout, others: &[&str]) -> Result<PathBuf, Failure> {
    build(&mut Tools::find(checkout)?.cargo_with_player(checkout)?, checkout, others)
}

fn build(cargo: &mut Command, checkout: &Checkout, others: &[&str]) -> Result<PathBuf, Failure> {
    cargo.args(["build", "--release", "--target", TARGET, setup::SCALED]);
    cargo.args(setup::PROGRAMS.iter().chain(others).flat_map(|package| ["-p", package]));
    steps::run(cargo, "see the first error above")?;
    Ok(checkout.target().join(TARGET).join("release"))
}
