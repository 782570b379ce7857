//! `cargo xtask bench`: builds what a benchmark needs, and runs it.

use std::ffi::OsString;

use gleaner_base::{Exit, Failure};

use crate::architecture::Architecture;
use crate::checkout::{Checkout, FAMILIES};
use crate::onnxruntime;
use crate::revisions;
use crate::setup;
use crate::steps::{self, Steps};
use crate::venv;

/// Packages of the stand-in for ROS 2.
const STAND_IN: [&str; 4] = ["cyclonedds", "numpy", "onnxruntime", "opencv-python-headless"];

/// Runs the benchmark that the first argument names, or compares results.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let name = arguments.first().and_then(|name| name.to_str()).unwrap_or_default();
    match (name, arguments) {
        ("fleet", [_, rest @ ..]) => fleet(checkout, rest),
        ("parts", [_, rest @ ..]) => parts(checkout, rest),
        ("compare", [_, rest @ ..]) if rest.len() > 2 => {
            let measured = steps::run_script(&mut revisions::script(checkout, rest))?;
            if measured != Exit::Ok {
                return Ok(measured);
            }
            let [base, head] = revisions::runs(checkout).map(OsString::from);
            analyse(checkout, &["compare".into(), base, head])
        }
        ("compare" | "render", _) => analyse(checkout, arguments),
        _ => measure(checkout, name, arguments),
    }
}

/// Measures the cloud under a simulated fleet: without lambdas, and on all cores.
fn fleet(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let mut steps = Steps::of(2);
    steps.begin("programs (the first time this takes minutes)");
    setup::programs(checkout)?;
    setup::binaries(checkout, &["gleaner-fleet-bench"])?;
    steps.begin("measurements");
    start(checkout, "gleaner-fleet-bench", arguments)
}

fn measure(checkout: &Checkout, name: &str, arguments: &[OsString]) -> Result<Exit, Failure> {
    let mut steps = Steps::of(setup::STEPS + 3);
    setup::run(checkout, &mut steps, &checkout.lambdas(&FAMILIES))?;
    steps.begin("programs for comparison");
    venv::set_up_for_tests(checkout)?;
    if ["rtt", "paper", "all"].contains(&name)
        && let Err(failure) = venv::apart(checkout, &checkout.target().join("baselines"), &STAND_IN)
    {
        println!("without the stand-in for ROS 2:\n{failure}");
    }
    // Lambdas and programs without Gleaner run a model by the same library.
    onnxruntime::fetch(checkout, Architecture::of_this_machine());
    steps.begin("gleaner-bench");
    setup::binaries(checkout, &["gleaner-bench"])?;
    steps.begin("measurements");
    start(checkout, "gleaner-bench", arguments)
}

/// Measures single functions. Divan prints a table, and has options of its own.
fn parts(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let mut bench = checkout.cargo();
    bench.args(["bench", "--bench", "parts", "--package", "gleaner-bench", "--"]).args(arguments);
    steps::run(&mut bench, "see the first error above").map(|()| Exit::Ok)
}

fn analyse(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    venv::set_up_for_tests(checkout)?;
    setup::binaries(checkout, &["gleaner-bench"])?;
    start(checkout, "gleaner-bench", arguments)
}

fn start(checkout: &Checkout, program: &str, arguments: &[OsString]) -> Result<Exit, Failure> {
    let mut bench = onnxruntime::with_models(checkout, program);
    bench.args(arguments);
    steps::run(&mut bench, "see the messages above").map(|()| Exit::Ok)
}
