//! `cargo xtask models`: runs the tests of the package `onnx`, and random graphs, on each backend
//! that runs models.

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::steps::{self, Steps};
use crate::venv;

/// Packages of Python. The results of other versions differ.
const PACKAGES: [&str; 3] = ["onnx==1.23.2", "onnxruntime==1.32.0", "numpy"];

/// Compares results, and the page that is generated from them.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut steps = Steps::of(3);
    steps.begin("ONNX and ONNX Runtime for Python");
    let python = venv::apart(checkout, &checkout.target().join("models"), &PACKAGES)?;
    steps.begin("program that runs models");
    let mut build = checkout.cargo();
    build.args(["build", "--release", "--example", "oracle"]);
    steps::run(&mut build, "see the first error above")?;
    steps.begin("models");
    let mut oracle = checkout.command(python);
    oracle.arg(checkout.path("tests/models/oracle.py"));
    oracle.arg(checkout.program("examples/oracle"));
    oracle.args(["--docs", "docs/models.md", "--check"]);
    let help = "a wrong result: refuse the model in host/inference/src/inspect/rten_rules.rs";
    steps::run(&mut oracle, help).map(|()| Exit::Ok)
}
