//! `cargo xtask`: fetches and builds everything beyond cargo, a C compiler and Python, and runs the
//! project's tasks.
//!
//! `checkout` finds paths, `setup` builds what is missing, `examples` replays the sample drive, and
//! each command has a file. Nothing here is installed.

mod aarch64;
mod architecture;
mod bench;
mod bless;
mod checkout;
mod deb;
mod demo;
mod dist;
mod docs;
mod examples;
mod fleet;
mod fuzz;
mod glibc;
mod metadata;
mod models;
mod onnxruntime;
mod page;
mod peers;
mod player;
mod private_folder;
mod records;
mod revisions;
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
  demo     replay the sample drive with both twins of every example, then run them on a vehicle of
           a cloud, whose page stays open until Ctrl-C; --no-wait ends after the checks, --no-fleet
           leaves the cloud out
  test     run all tests; the last line is `N passed, M failed, K skipped`; --shared runs those
           that read GLEANER_SHARED, and those of the pages
  full     run every part of .ci/run, and record the heavy ones in .ci/full.json
  record   print the record of the heavy part NAME, if its sources are the same as then
  bless    write the examples' decisions to expected.txt, and the generated files
  docs     fetch mdBook and build the pages as a book in target/book
  bench    run a benchmark: rtt, scale, isolation, cold-start, replay, record, drives, kernels,
           inference, fleet or parts; `all` runs all but fleet and parts, and packs the results into
           one file; `compare A B` compares two results, and `compare BASE HEAD NAME` measures two
           revisions in turns; see bench/README.md
  fleet    serve the cloud as three replicas on this machine, until ctrl-C; --install fetches its
           packages first, --kills N kills its programs in turn under simulated vehicles
  peers    build test programs on other DDS implementations; --install fetches their packages first
  page     use the cloud's page in Chromium; --install fetches the browser's package first
  models   run the tests of ONNX, and random graphs, on each backend that runs models
  player   fetch the tools for gleaner-player, which plays drives with Cyclone DDS, and build it
  fuzz     fuzz parsers of untrusted input; [TARGET...] [--seconds N] [--seed N]
  aarch64  build for ARM vehicles, and compare the decisions of lambdas there, emulated
  build    only set up: wasm target, Python environment, programs, lambdas
  deb      build the Debian packages; [--arch amd64|arm64] [--programs DIR] [--test]
  dist     build the Debian packages, and a tarball with the bench, for machines without a
           toolchain; [--target aarch64|x86_64] [--out DIR] [--programs DIR] [--install]";

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
    let checkout = Checkout::find()?;
    match (command, rest) {
        ("demo", _) => demo::run(&checkout, rest),
        (demo::VEHICLE_COMMAND, _) => demo::run_vehicle(&checkout, rest),
        ("full", []) => records::full(&checkout),
        ("record", _) => records::print(&checkout, rest),
        ("test", _) => suites::run(&checkout, rest),
        ("bless", []) => bless::run(&checkout),
        ("docs", []) => docs::run(&checkout),
        ("bench", _) => bench::run(&checkout, rest),
        ("fleet", _) => fleet::run_scaled(&checkout, rest),
        ("fuzz", _) => fuzz::run(&checkout, rest),
        ("models", []) => models::run(&checkout),
        ("page", _) => page::run_flows(&checkout, rest),
        ("peers", _) => peers::build(&checkout, rest),
        ("player", []) => player::run(&checkout),
        ("deb", _) => deb::run(&checkout, rest),
        ("dist", _) => dist::run(&checkout, rest),
        ("aarch64", []) => aarch64::run(&checkout),
        ("build", []) => {
            setup::run(&checkout, &mut Steps::of(setup::STEPS), &checkout.lambdas(&FAMILIES))
                .map(|()| Exit::Ok)
        }
        ("", _) => Err(Failure::new(Exit::Usage, "a command is missing").with_help(USAGE)),
        _ => {
            let message = format!("`cargo xtask {command}` is unknown, or takes no arguments");
            Err(Failure::new(Exit::Usage, message).with_help(USAGE))
        }
    }
}
