//! `cargo xtask page`: uses the page of the cloud in a real browser, with vehicles that are not
//! real. `--install` fetches the browser's package first.

use std::ffi::OsString;
use std::path::Path;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::steps::{self, Steps, run, succeeds};

/// The browser, as Debian's package has it.
const BROWSER: &str = "/usr/bin/chromium";

/// Packages of npm, with their versions: the driver of the browser, and the check of accessibility.
const MODULES: [&str; 2] = ["playwright-core@1.65.1", "axe-core@4.14.1"];

/// Runs the flows of `cloud/tests/page`.
pub(crate) fn run_flows(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let is_installing = steps::has_flag("page", "--install", arguments)?;
    let folder = checkout.target().join("page");
    let mut steps = Steps::of(4);
    steps.begin("browser, and Node.js 20 or newer");
    steps::require_packages(checkout, "page", is_installing, || missing(checkout))?;
    steps.begin("driver of the browser");
    modules(checkout, &folder)?;
    steps.begin("a cloud with vehicles");
    let mut build = checkout.cargo();
    build.args(["build", "--release", "--example", "page_fleet"]);
    run(&mut build, "see the first error above")?;
    steps.begin("flows");
    let mut node = checkout.command("node");
    node.arg(checkout.path("cloud/tests/page/flows.mjs"));
    node.arg(folder.join("node_modules")).arg(checkout.program("examples/page_fleet"));
    node.arg(BROWSER).arg(folder.join("screenshots"));
    let help = format!("screenshots are in `{}`", folder.join("screenshots").display());
    run(&mut node, &help).map(|()| Exit::Ok)
}

/// Returns the packages whose programs do not run, or are too old for the driver.
fn missing(checkout: &Checkout) -> Vec<&'static str> {
    let is_new = "process.exit(parseInt(process.versions.node) >= 20 ? 0 : 1)";
    let mut programs = [
        ("chromium", checkout.command(BROWSER), &["--version"][..]),
        ("nodejs", checkout.command("node"), &["-e", is_new]),
        ("npm", checkout.command("npm"), &["--version"]),
    ];
    let missing = programs.iter_mut().filter_map(|(package, program, arguments)| {
        (!succeeds(program.args(*arguments))).then_some(*package)
    });
    missing.collect()
}

fn modules(checkout: &Checkout, folder: &Path) -> Result<(), Failure> {
    steps::make_folder(folder)?;
    let mut install = checkout.command("npm");
    // Scripts of packages are not run: these need none.
    install.args(["install", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline"]);
    install.arg("--prefix").arg(folder).args(MODULES);
    steps::download(&mut install, "check the network, or configure a mirror for npm")
}
