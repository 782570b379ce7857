//! `cargo xtask test`: every suite of the project, one after the other, and one count at the end.
//!
//! A suite that fails does not keep the next from running. `tally` counts from what a suite prints;
//! nothing else knows how the different test runners speak.

mod memory;
mod tally;

use std::env;
use std::io::{self, BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Command, ExitStatus, Stdio};
use std::time::Instant;

use gleaner_base::{Exit, Failure};

use crate::checkout::{Checkout, FAMILIES};
use crate::fuzz;
use crate::player;
use crate::setup;
use crate::steps::{Steps, succeeds};
use crate::venv;
use tally::{Speech, Tally};

struct Suite {
    name: String,
    how: How,
}

enum How {
    Run(Command, Speech),
    /// What is missing. It counts as one skipped test.
    Skip(&'static str),
}

/// Sets up and runs all tests. The last line says `N passed, M failed, K skipped`.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut suites = suites(checkout);
    suites.extend(player_suites(checkout)?);
    let mut steps = Steps::of(setup::STEPS + 1 + suites.len());
    setup::run(checkout, &mut steps, &checkout.lambdas(&FAMILIES))?;
    fuzz::driver(checkout)?;
    steps.begin("mypy, pytest, readers of drives, and what runs notebooks");
    venv::set_up_for_tests(checkout)?;
    let mut total = Tally::new(Speech::None);
    let mut table =
        format!("\n{:<44} {:>7} {:>7} {:>7} {:>7}\n", "suite", "passed", "failed", "skipped", "s");
    let folder = memory::Folder::new();
    for mut suite in suites {
        steps.begin(&suite.name);
        if let (Some(folder), How::Run(command, _)) = (&folder, &mut suite.how) {
            command.env("TMPDIR", folder.path());
        }
        let started = Instant::now();
        let tally = suite.how.run();
        let seconds = started.elapsed().as_secs_f64();
        let Tally { passed, failed, skipped, .. } = &tally;
        table +=
            &format!("{:<44} {passed:>7} {failed:>7} {skipped:>7} {seconds:>7.1}\n", suite.name);
        total.add(tally, &suite.name);
    }
    print!("{table}");
    for name in &total.names {
        println!("FAILED {name}");
    }
    println!("{} passed, {} failed, {} skipped", total.passed, total.failed, total.skipped);
    Ok(if total.failed == 0 { Exit::Ok } else { Exit::Internal })
}

fn suites(checkout: &Checkout) -> Vec<Suite> {
    let suite = |name: &str, command, speech| Suite {
        name: name.to_owned(),
        how: How::Run(command, speech),
    };

    let mut tests = checkout.cargo();
    tests.args(["test", "--release", "--no-fail-fast"]);

    // Of the fuzz targets, with the features of all that is built by default, so that nothing is
    // built twice.
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

    // In target folders of their own: their flags would have everything else compiled anew.
    let mut loom = checkout.cargo();
    loom.args(["test", "--release", "-p", "gleaner-buffers", "--test", "loom"])
        .env("CARGO_TARGET_DIR", checkout.target().join("loom"))
        .env("RUSTFLAGS", "--cfg loom")
        .env("LOOM_MAX_PREEMPTIONS", "3");

    let mut unittest = checkout.command(checkout.python());
    unittest
        .args(["-m", "unittest", "discover", "-v", "guest-sdk-python/tests"])
        .env("GLEANER_EXTENSION", checkout.program("lib_gleaner.so"));

    // As users test lambdas, with the SDK of this checkout.
    let mut pytest = checkout.command(checkout.python());
    pytest
        .args(["-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "examples"])
        .env("PYTHONPATH", checkout.path("guest-sdk-python"))
        .env("PYTHONDONTWRITEBYTECODE", "1");

    let mut suites = vec![
        suite("cargo test", tests, Speech::Libtest),
        suite("cargo test: seeds of the fuzz targets", seeds, Speech::Libtest),
        suite("loom: orders of threads in gleaner-buffers", loom, Speech::Libtest),
        Suite { name: "miri: memory in gleaner-buffers".to_owned(), how: miri(checkout) },
        suite("unittest: Python SDK", unittest, Speech::Unittest),
        suite("pytest: examples and notebooks", pytest, Speech::Pytest),
    ];
    suites.extend(typed(checkout).into_iter().map(|file| {
        let mut mypy = checkout.command(checkout.python());
        mypy.args(["-m", "mypy", "--strict", "--cache-dir"])
            .arg(checkout.target().join("mypy"))
            .arg(&file)
            .env("MYPYPATH", checkout.path("guest-sdk-python"));
        suite(&format!("mypy: {}", file.display()), mypy, Speech::None)
    }));
    suites
}

/// What has to hold of the player, where it was built: it is no default member.
fn player_suites(checkout: &Checkout) -> Result<Vec<Suite>, Failure> {
    let suite = |name: &str, how| Suite { name: name.to_owned(), how };
    if !checkout.program("gleaner-player").is_file() {
        return Ok(vec![suite(
            "cargo test: player",
            How::Skip("no gleaner-player; run: cargo xtask player"),
        )]);
    }
    let mut lints = player::cargo(checkout)?;
    lints.args([
        "clippy",
        "--release",
        "-p",
        "gleaner-player",
        "--all-targets",
        "--",
        "-D",
        "warnings",
    ]);
    let mut tests = player::cargo(checkout)?;
    tests.args([
        "test",
        "--release",
        "--workspace",
        "--bin",
        "gleaner-player",
        "--test",
        "program",
    ]);
    Ok(vec![
        suite("lints: player", How::Run(lints, Speech::None)),
        suite("cargo test: player", How::Run(tests, Speech::Libtest)),
    ])
}

/// What mypy checks, relative to the checkout: the SDK and its tests, and each lambda by itself, as
/// all are called `main`.
fn typed(checkout: &Checkout) -> Vec<PathBuf> {
    let mains = checkout.lambdas(&FAMILIES).into_iter().map(|lambda| lambda.join("main.py"));
    let mains = mains.filter(|main| checkout.path(main).is_file());
    ["guest-sdk-python/gleaner", "guest-sdk-python/tests"]
        .map(PathBuf::from)
        .into_iter()
        .chain(mains)
        .collect()
}

fn miri(checkout: &Checkout) -> How {
    // Only rustup's cargo understands `+nightly`; ours is the cargo of one toolchain, and names it
    // to its children.
    let cargo = || {
        let mut cargo = checkout.command("cargo");
        cargo.arg("+nightly").arg("miri").env_remove("CARGO").env_remove("RUSTUP_TOOLCHAIN");
        cargo
    };
    if !succeeds(cargo().arg("--version")) {
        return How::Skip("needs miri: `rustup +nightly component add miri rust-src`");
    }
    let mut tests = cargo();
    tests
        .args(["test", "-p", "gleaner-buffers", "--no-fail-fast"])
        .env("CARGO_TARGET_DIR", checkout.target().join("miri"));
    // No pointer may be made up from a number; unless the user wants other checks.
    if env::var_os("MIRIFLAGS").is_none() {
        tests.env("MIRIFLAGS", "-Zmiri-strict-provenance");
    }
    How::Run(tests, Speech::Libtest)
}

impl How {
    fn run(self) -> Tally {
        match self {
            How::Skip(why) => {
                println!("skipped: {why}");
                let mut tally = Tally::new(Speech::None);
                tally.skipped = 1;
                tally
            }
            How::Run(command, speech) => {
                let program = command.get_program().display().to_string();
                let mut tally = Tally::new(speech);
                match listen(command, &mut tally) {
                    Ok(status) => tally.end(status.success(), &format!("ended with {status}")),
                    Err(error) => tally.end(false, &format!("cannot run `{program}`: {error}")),
                }
                tally
            }
        }
    }
}

/// Runs a suite and shows what it says, on both streams in the order in which it does, while
/// `tally` listens.
fn listen(mut command: Command, tally: &mut Tally) -> io::Result<ExitStatus> {
    let (said, speak) = io::pipe()?;
    let mut child =
        command.stdin(Stdio::null()).stdout(speak.try_clone()?).stderr(speak).spawn()?;
    // It holds our ends for writing: with them open, reading would never come to an end.
    drop(command);
    let mut said = BufReader::new(said);
    let mut line = Vec::new();
    while said.read_until(b'\n', &mut line)? > 0 {
        let mut out = io::stdout().lock();
        out.write_all(&line)?;
        out.flush()?;
        tally.hear(String::from_utf8_lossy(&line).trim_end());
        line.clear();
    }
    child.wait()
}
