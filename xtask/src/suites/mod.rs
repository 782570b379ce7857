//! `cargo xtask test`: runs all test suites one after the other, and prints the total counts.
//!
//! All suites run even if one fails. `counts` parses the output of the different test runners.

mod counts;
mod memory;

use std::env;
use std::io::{self, BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Command, ExitStatus, Stdio};
use std::time::Instant;

use gleaner_base::{Exit, Failure};

use crate::bindings;
use crate::checkout::{Checkout, FAMILIES};
use crate::fuzz;
use crate::player;
use crate::setup;
use crate::steps::{Steps, succeeds};
use crate::venv;
use counts::{OutputFormat, TestCounts};

/// Features with which `.ci/run` checks the workspace.
const LINTED: &str = "gleaner-fuzz/calls,gleaner-fuzz/programs";

struct Suite {
    name: String,
    action: SuiteAction,
}

enum SuiteAction {
    Run(Command, OutputFormat),
    /// Skips the suite for this reason. It counts as one skipped test.
    Skip(&'static str),
}

/// Sets up and runs all tests. The last line is `N passed, M failed, K skipped`.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut suites = suites(checkout);
    suites.extend(player_suites(checkout)?);
    let mut steps = Steps::of(setup::STEPS + 1 + suites.len());
    setup::run(checkout, &mut steps, &checkout.lambdas(&FAMILIES))?;
    fuzz::driver(checkout)?;
    steps.begin("mypy, pytest, drive readers and notebook tools");
    venv::set_up_for_tests(checkout)?;
    let mut total = TestCounts::new(OutputFormat::None);
    let mut table =
        format!("\n{:<44} {:>7} {:>7} {:>7} {:>7}\n", "suite", "passed", "failed", "skipped", "s");
    let folder = memory::MemoryFolder::new();
    for mut suite in suites {
        steps.begin(&suite.name);
        if let (Some(folder), SuiteAction::Run(command, _)) = (&folder, &mut suite.action) {
            command.env("TMPDIR", folder.path());
        }
        let started = Instant::now();
        let counts = suite.action.run();
        let seconds = started.elapsed().as_secs_f64();
        let TestCounts { passed, failed, skipped, .. } = &counts;
        table +=
            &format!("{:<44} {passed:>7} {failed:>7} {skipped:>7} {seconds:>7.1}\n", suite.name);
        total.add(counts, &suite.name);
    }
    print!("{table}");
    for name in &total.names {
        println!("FAILED {name}");
    }
    println!("{} passed, {} failed, {} skipped", total.passed, total.failed, total.skipped);
    Ok(if total.failed == 0 { Exit::Ok } else { Exit::Internal })
}

fn suites(checkout: &Checkout) -> Vec<Suite> {
    let suite = |name: &str, command, format| Suite {
        name: name.to_owned(),
        action: SuiteAction::Run(command, format),
    };

    let mut tests = checkout.cargo();
    tests.args(["test", "--release", "--no-fail-fast"]);

    // Seeds of the fuzz targets, with the features of the default build, so that nothing is built
    // twice.
    let mut seeds = checkout.cargo();
    seeds.args([
        "test",
        "--release",
        "--workspace",
        "--exclude",
        "gleaner-player",
        "--features",
        "gleaner-fuzz/calls",
    ]);
    seeds.args(["--test", "seeds"]);

    // In a separate target folder, since its flags would recompile everything else.
    let mut loom = checkout.cargo();
    loom.args([
        "test",
        "--release",
        "-p",
        "gleaner-buffers",
        "--test",
        "loom",
        "--test",
        "loom_shared",
    ])
    .env("CARGO_TARGET_DIR", checkout.target().join("loom"))
    .env("RUSTFLAGS", "--cfg loom")
    .env("LOOM_MAX_PREEMPTIONS", "3");

    let mut unittest = checkout.command(checkout.python());
    unittest
        .args(["-m", "unittest", "discover", "-v", "guest-sdk-python/tests"])
        .env("GLEANER_EXTENSION", checkout.program("lib_gleaner.so"))
        .env("GLEANER_CLOUD_PROGRAM", checkout.program("gleaner-cloud"));

    // As users test lambdas, with the SDK of this checkout.
    let mut pytest = checkout.command(checkout.python());
    pytest
        .args([
            "-m",
            "pytest",
            "-q",
            "-rs",
            "-p",
            "no:cacheprovider",
            "examples",
            "bench/baselines",
        ])
        .env("PYTHONPATH", checkout.path("guest-sdk-python"))
        .env("PYTHONDONTWRITEBYTECODE", "1");

    let mut suites = vec![
        suite("cargo test", tests, OutputFormat::Libtest),
        suite("cargo test: seeds of the fuzz targets", seeds, OutputFormat::Libtest),
        suite(
            "cargo test: bindings of the Rust SDK",
            bindings::test(checkout),
            OutputFormat::Libtest,
        ),
        suite("loom: orders of threads in gleaner-buffers", loom, OutputFormat::Libtest),
        Suite { name: "miri: memory in gleaner-buffers".to_owned(), action: miri(checkout) },
        suite("unittest: Python SDK", unittest, OutputFormat::Unittest),
        suite("pytest: examples, notebooks and baselines", pytest, OutputFormat::Pytest),
    ];
    suites.extend(typed(checkout).into_iter().map(|file| {
        let mut mypy = checkout.command(checkout.python());
        mypy.args(["-m", "mypy", "--strict", "--cache-dir"])
            .arg(checkout.target().join("mypy"))
            .arg(&file)
            .env("MYPYPATH", checkout.path("guest-sdk-python"));
        suite(&format!("mypy: {}", file.display()), mypy, OutputFormat::None)
    }));
    suites
}

/// Suites of the player, if it was built: it is not a default member.
fn player_suites(checkout: &Checkout) -> Result<Vec<Suite>, Failure> {
    let suite = |name: &str, action| Suite { name: name.to_owned(), action };
    if !checkout.program("gleaner-player").is_file() {
        return Ok(vec![suite(
            "cargo test: player",
            SuiteAction::Skip("no gleaner-player; run: cargo xtask player"),
        )]);
    }
    // With the features of the whole workspace, and in lints with those of `.ci/run`, so that
    // nothing is built twice.
    let only = ["--release", "--workspace", "--bin", "gleaner-player", "--test", "player"];
    let mut lints = player::cargo(checkout, &player::compiler())?;
    lints.arg("clippy").args(only).args(["--features", LINTED, "--", "-D", "warnings"]);
    let mut tests = player::cargo(checkout, &player::compiler())?;
    tests.arg("test").args(only);
    Ok(vec![
        suite("lints: player", SuiteAction::Run(lints, OutputFormat::None)),
        suite("cargo test: player", SuiteAction::Run(tests, OutputFormat::Libtest)),
    ])
}

/// Paths that mypy checks, relative to the checkout: the SDK, its tests, and each lambda
/// separately, since all are named `main`.
fn typed(checkout: &Checkout) -> Vec<PathBuf> {
    let mains = checkout.lambdas(&FAMILIES).into_iter().map(|lambda| lambda.join("main.py"));
    let mains = mains.filter(|main| checkout.path(main).is_file());
    ["guest-sdk-python/gleaner", "guest-sdk-python/tests"]
        .map(PathBuf::from)
        .into_iter()
        .chain(mains)
        .collect()
}

fn miri(checkout: &Checkout) -> SuiteAction {
    // Only rustup's cargo understands `+nightly`. The current cargo belongs to one toolchain, which
    // it passes to its children.
    let cargo = || {
        let mut cargo = checkout.command("cargo");
        cargo.arg("+nightly").arg("miri").env_remove("CARGO").env_remove("RUSTUP_TOOLCHAIN");
        cargo
    };
    if !succeeds(cargo().arg("--version")) {
        return SuiteAction::Skip("needs miri: `rustup +nightly component add miri rust-src`");
    }
    let mut tests = cargo();
    tests
        .args(["test", "-p", "gleaner-buffers", "--no-fail-fast"])
        .env("CARGO_TARGET_DIR", checkout.target().join("miri"));
    // Forbids pointers made from integers, unless the user has set other flags.
    if env::var_os("MIRIFLAGS").is_none() {
        tests.env("MIRIFLAGS", "-Zmiri-strict-provenance");
    }
    SuiteAction::Run(tests, OutputFormat::Libtest)
}

impl SuiteAction {
    fn run(self) -> TestCounts {
        match self {
            SuiteAction::Skip(why) => {
                println!("skipped: {why}");
                let mut counts = TestCounts::new(OutputFormat::None);
                counts.skipped = 1;
                counts
            }
            SuiteAction::Run(command, format) => {
                let program = command.get_program().display().to_string();
                let mut counts = TestCounts::new(format);
                match run_and_count(command, &mut counts) {
                    Ok(status) => counts.end(status.success(), &format!("ended with {status}")),
                    Err(error) => counts.end(false, &format!("cannot run `{program}`: {error}")),
                }
                counts
            }
        }
    }
}

/// Runs a suite, shows the output of both streams in order, and counts the tests in it.
fn run_and_count(mut command: Command, counts: &mut TestCounts) -> io::Result<ExitStatus> {
    let (reader, writer) = io::pipe()?;
    let mut child =
        command.stdin(Stdio::null()).stdout(writer.try_clone()?).stderr(writer).spawn()?;
    // The command holds write ends of the pipe: with them open, reading would never end.
    drop(command);
    let mut reader = BufReader::new(reader);
    let mut line = Vec::new();
    while reader.read_until(b'\n', &mut line)? > 0 {
        let mut out = io::stdout().lock();
        out.write_all(&line)?;
        out.flush()?;
        counts.parse_line(String::from_utf8_lossy(&line).trim_end());
        line.clear();
    }
    child.wait()
}
