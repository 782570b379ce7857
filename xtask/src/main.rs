//! `cargo xtask`: everything a fresh machine needs beyond cargo, a C compiler and Python is fetched
//! and built here.
//!
//! `checkout` knows where things are, `setup` makes what is missing, `examples` replays the sample
//! drive, and each command is a file that says what it does after that. Nothing here is part of
//! what is installed.

mod aarch64;
mod bless;
mod checkout;
mod demo;
mod docs;
mod examples;
mod fuzz;
mod peers;
mod player;
mod setup;
mod steps;
mod suites;
mod venv;

use std::env;
use std::ffi::OsString;
use std::process::ExitCode;

use gleaner_base::{Exit, Failure};

use checkout::{Checkout, FAMILIES};
use steps::Steps;

const USAGE: &str = "usage: cargo xtask COMMAND
  demo   run both twins of every example over the sample drive, and show what they decided
  test   run all tests; the last line is `N passed, M failed, K skipped`
  bless  write what the examples decide on the sample drive to expected.txt, and what is made of the manifest's types
  docs   fetch mdBook and build the pages as a book, in target/book
  bench  measure what is promised; what follows goes to gleaner-bench
  peers  build programs on other DDS for the tests of live topics; --install fetches their packages first
  player build gleaner-player, which plays drives with Cyclone DDS, and fetch what that takes
  fuzz   feed what reads foreign bytes with made-up ones; [TARGET...] [--seconds N] [--seed N]
  aarch64  build for vehicles with an ARM processor, and compare what lambdas decide there, emulated
  build  only set up: wasm target, Python environment, programs, lambdas";

fn main() -> ExitCode {
    match run(env::args_os().skip(1).collect()) {
        Ok(exit) => exit.into(),
        Err(failure) => {
            eprintln!("{failure}");
            failure.exit.into()
        }
    }
}

fn run(arguments: Vec<OsString>) -> Result<Exit, Failure> {
    let (command, rest) = match arguments.split_first() {
        Some((command, rest)) => (command.to_str().unwrap_or_default(), rest),
        None => ("", &[][..]),
    };
    if !rest.is_empty() && !["bench", "fuzz", "peers"].contains(&command) {
        return Err(Failure::new(
            Exit::Usage,
            format!("`cargo xtask {command}` takes no arguments"),
        )
        .with_help(USAGE));
    }
    let checkout = Checkout::find()?;
    match command {
        "demo" => demo::run(&checkout),
        "test" => suites::run(&checkout),
        "bless" => bless::run(&checkout),
        "docs" => docs::run(&checkout),
        "bench" => bench(&checkout, rest),
        "fuzz" => fuzz::run(&checkout, rest),
        "peers" => peers::build(&checkout, rest),
        "player" => player::run(&checkout),
        "aarch64" => aarch64::run(&checkout),
        "build" => {
            setup::run(&checkout, &mut Steps::of(setup::STEPS), &checkout.lambdas(&FAMILIES))
                .map(|()| Exit::Ok)
        }
        _ => Err(Failure::new(Exit::Usage, "no such command").with_help(USAGE)),
    }
}

fn bench(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let mut steps = Steps::of(setup::STEPS + 3);
    setup::run(checkout, &mut steps, &checkout.lambdas(&FAMILIES))?;
    steps.begin("readers of drives, to compare with");
    venv::set_up_for_tests(checkout)?;
    steps.begin("gleaner-bench");
    let mut build = checkout.cargo();
    // By its name alone: cargo chooses features by the packages that are named, and none of it is
    // to compile twice.
    steps::run(
        build.args(["build", "--release", "--bin", "gleaner-bench"]),
        "see the first error above",
    )?;
    steps.begin("measurements");
    let mut bench = checkout.command(checkout.program("gleaner-bench"));
    bench.args(arguments);
    steps::run(&mut bench, "look at what it says above").map(|()| Exit::Ok)
}
