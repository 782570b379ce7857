//! `cargo xtask aarch64`: builds the programs of an ARM vehicle, and checks that lambdas decide
//! there as they do here: every decision of the same replays, bit for bit, and its fuel.
//!
//! The ARM programs run in qemu's user mode, which emulates the processor but uses this machine's
//! kernel. So this tests neither speed nor isolation: qemu supports neither Landlock nor seccomp,
//! and the programs report these layers as missing. qemu also lacks a system call that
//! `gleaner-shim` needs to start, so that program is built but not run: this machine's shim is used
//! instead.

mod cases;
mod compare;
mod tools;

use std::env;
use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::setup;
use crate::steps::{self, Steps, cannot};
use cases::{CASES, Machine, ReplayCase};
use tools::Emulator;
pub(crate) use tools::{TARGET, Tools};

const PROGRAMS: [&str; 4] = ["gleaner", "gleaner-compile", "gleaner-inference", "gleaner-runtime"];
const SHIM: &str = "gleaner-shim";

pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    if env::consts::ARCH == "aarch64" {
        return Err(Failure::new(Exit::Usage, "this machine is itself an aarch64")
            .with_help("run `cargo xtask demo`"));
    }
    let mut steps = Steps::of(5);
    steps.begin(&format!("cross compiler, emulator and compilation target {TARGET}"));
    let tools = Tools::find(checkout)?;
    let emulator = Emulator::find(checkout, &tools)?;
    steps.begin("programs and lambdas for this machine (the first time this takes minutes)");
    setup::target(checkout, setup::TARGET)?;
    setup::programs(checkout)?;
    setup::build_lambdas(checkout, &cases::lambdas())?;
    steps.begin(&format!("programs for {TARGET} (the first time this takes minutes)"));
    let built = build(&mut tools.cargo(checkout), checkout, &[])?;
    let emulated = scripts(checkout, &built, &emulator)?;
    println!("built {}", checkout.target().join(TARGET).join("release").display());
    steps.begin("native code of the other processor must be refused");
    let (here, there) = (Machine::here(checkout), Machine::emulated(checkout, emulated));
    println!("{}", cases::foreign_code(&here, &there)?);
    steps.begin(&format!("{} replays, each on both processors", CASES.len()));
    let unexpected =
        CASES.iter().map(|case| compare(case, &here, &there)).sum::<Result<usize, Failure>>()?;
    println!("{} of {} replays as expected", CASES.len() - unexpected, CASES.len());
    println!("files: {}/", cases::OUT);
    Ok(if unexpected == 0 { Exit::Ok } else { Exit::Differs })
}

/// Builds the programs of packages, and those of the packages `others` of cargo, of which one is
/// the player; returns their folder.
pub(crate) fn programs(checkout: &Checkout, others: &[&str]) -> Result<PathBuf, Failure> {
    build(&mut Tools::find(checkout)?.cargo_with_player(checkout)?, checkout, others)
}

fn build(cargo: &mut Command, checkout: &Checkout, others: &[&str]) -> Result<PathBuf, Failure> {
    cargo.args(["build", "--release", "--target", TARGET]);
    cargo.args(setup::PROGRAMS.iter().chain(others).flat_map(|package| ["-p", package]));
    steps::run(cargo, "see the first error above")?;
    Ok(checkout.target().join(TARGET).join("release"))
}

/// Writes a script for each program that starts it emulated. Returns the folder of the scripts.
fn scripts(checkout: &Checkout, built: &Path, emulator: &Emulator<'_>) -> Result<PathBuf, Failure> {
    let scripts = checkout.target().join(TARGET).join("emulated");
    let here = (SHIM, Emulator::native_script(&checkout.program(SHIM)));
    for (name, script) in
        PROGRAMS.map(|name| (name, emulator.script(&built.join(name)))).into_iter().chain([here])
    {
        let file = scripts.join(name);
        steps::write_file(&file, &script)?;
        fs::set_permissions(&file, Permissions::from_mode(0o755))
            .map_err(|error| cannot("change", &file, &error))?;
    }
    Ok(scripts)
}

/// Compares one case and prints the result. Returns 1 if it is unexpected, else 0.
fn compare(case: &ReplayCase, here: &Machine<'_>, there: &Machine<'_>) -> Result<usize, Failure> {
    let [a, b] = [case.replay(here)?, case.replay(there)?];
    let difference = compare::difference(&a, &b);
    let verdict = match (&difference, case.known_difference) {
        (None, None) => format!("equal, {}", case.verify(here, there)?),
        (Some(what), None) => format!("DIFFERS in {what}"),
        (Some(what), Some(why)) => format!("differs as expected, {why}: {what}"),
        (None, Some(why)) => format!("EQUAL, but must differ: {why}"),
    };
    let times = format!("{:.1} s here, {:.1} s emulated", a.seconds, b.seconds);
    println!("{}\n  {}; {times}\n  {verdict}", case.name(), compare::counts(&a.decisions));
    Ok(usize::from(difference.is_some() != case.known_difference.is_some()))
}
