//! `cargo xtask test`: runs all test suites, two at a time, and prints the total counts.
//!
//! All suites run even if one fails. `group` runs one in bounds, and `junit` and `counts` read the
//! results of their test runners.

mod counts;
mod group;
mod junit;
mod memory;

use std::collections::VecDeque;
use std::env;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::Command;
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};

use crate::architecture::Architecture;
use crate::checkout::{Checkout, FAMILIES};
use crate::fuzz;
use crate::onnxruntime;
use crate::player;
use crate::setup;
use crate::steps::{self, Steps, succeeds};
use crate::venv;
use counts::{LibtestParser, TestCounts};
use group::SuiteBounds;

/// Features with which `.ci/run` checks the workspace.
const LINTED: &str = "gleaner-fuzz/programs";

/// Number of suites that run at a time. Most tests wait for processes and clocks.
const AT_A_TIME: usize = 2;

/// Time after which a suite is ended. Suites compile their tests first; on two ordinary cores, all
/// of them take a fifth of it.
const TIME_MAX: Duration = Duration::from_secs(3600);

struct Suite {
    name: String,
    action: SuiteAction,
}

enum SuiteAction {
    Run(Box<Command>, SuiteResults),
    /// Skips the suite for this reason. It counts as one skipped test.
    Skip(&'static str),
}

enum SuiteResults {
    /// Lines of Rust test programs.
    Libtest,
    /// A file, written at the end.
    JUnit(PathBuf),
    /// The exit status, as the result of one test.
    Status,
}

struct EndedSuite {
    name: String,
    counts: TestCounts,
    seconds: f64,
}

/// Tests that read files in the folder of `GLEANER_SHARED`, and those of the pages, as packages
/// with their test programs. A test compares the list with the sources.
const READ_SHARED: &str = "binary(drives) | binary(architecture) | package(gleaner-pixels) & binary(vision) \
                           | package(gleaner-inference) & binary(suite) | package(imu-fft)";

/// Sets up and runs all tests, or with `--shared` those of [`READ_SHARED`]. The last line is
/// `N passed, M failed, K skipped`.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let is_shared = steps::has_flag("test", "--shared", arguments)?;
    if is_shared { run_shared(checkout) } else { run_tests(checkout) }
}

fn run_shared(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut suites = if has_nextest(checkout) {
        vec![nextest(checkout, &["-E", READ_SHARED])]
    } else {
        let programs = ["--test", "drives", "--test", "architecture", "--test", "vision"];
        let tests = cargo_test(checkout, &[&programs[..], &["--test", "suite", "--lib"]].concat());
        vec![suite("cargo test", tests, SuiteResults::Libtest)]
    };
    suites.push(pytest(checkout, "examples", &["examples"]));
    Ok(report(run_all(suites)))
}

fn run_tests(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut steps = Steps::of(setup::STEPS + 2);
    setup::run(checkout, &mut steps, &checkout.lambdas(&FAMILIES))?;
    fuzz::driver(checkout)?;
    steps.begin("mypy, pytest, drive readers, notebook tools and ONNX Runtime");
    venv::set_up_for_tests(checkout)?;
    onnxruntime::fetch(checkout, Architecture::of_this_machine());
    let mut suites = suites(checkout);
    suites.extend(player_suites(checkout)?);
    steps.begin(&format!("{} suites, {AT_A_TIME} at a time", suites.len()));
    let folder = memory::MemoryFolder::new();
    for suite in &mut suites {
        if let (Some(folder), SuiteAction::Run(command, _)) = (&folder, &mut suite.action) {
            command.env("TMPDIR", folder.path());
        }
    }
    Ok(report(run_all(suites)))
}

/// Runs the suites, each with its output in one block, except the first, whose output is shown as
/// it comes.
fn run_all(suites: Vec<Suite>) -> Vec<EndedSuite> {
    let waiting = Mutex::new(suites.into_iter().enumerate().collect::<VecDeque<_>>());
    let ended = Mutex::new(Vec::new());
    let bounds = SuiteBounds::new(TIME_MAX);
    bounds.end_by_signals();
    let next = || waiting.lock().unwrap_or_else(|it| it.into_inner()).pop_front();
    let work = || {
        while let Some((index, Suite { name, action })) = next() {
            let mut output = SuiteOutput { block: Vec::new(), is_shown: index == 0 };
            output.line(format!("== {name} ==\n").as_bytes());
            let started = Instant::now();
            let counts = action.run(&bounds, &mut output);
            let seconds = started.elapsed().as_secs_f64();
            output.end();
            let suite = EndedSuite { name, counts, seconds };
            ended.lock().unwrap_or_else(|it| it.into_inner()).push((index, suite));
        }
    };
    thread::scope(|scope| {
        for _ in 0..AT_A_TIME {
            scope.spawn(work);
        }
    });
    let mut ended = ended.into_inner().unwrap_or_else(|it| it.into_inner());
    ended.sort_by_key(|(index, _)| *index);
    ended.into_iter().map(|(_, suite)| suite).collect()
}

/// Output of a suite: shown, or collected until its end.
struct SuiteOutput {
    block: Vec<u8>,
    is_shown: bool,
}

impl SuiteOutput {
    fn line(&mut self, line: &[u8]) {
        self.block.extend_from_slice(line);
        if self.is_shown {
            self.end();
        }
    }

    fn end(&mut self) {
        let mut out = io::stdout().lock();
        let _ = out.write_all(&self.block).and_then(|()| out.flush());
        self.block.clear();
    }
}

/// Prints the counts of each suite, the skipped and the failed tests, and the total.
fn report(suites: Vec<EndedSuite>) -> Exit {
    println!("\n{:<44} {:>7} {:>7} {:>7} {:>7}", "suite", "passed", "failed", "skipped", "s");
    let mut total = TestCounts::default();
    for EndedSuite { name, counts, seconds } in suites {
        let (passed, failed, skipped) = (counts.passed, counts.failed.len(), counts.skipped.len());
        println!("{name:<44} {passed:>7} {failed:>7} {skipped:>7} {seconds:>7.1}");
        total.add(counts, &name);
    }
    for name in &total.skipped {
        println!("skipped {name}");
    }
    for name in &total.failed {
        println!("FAILED {name}");
    }
    let (failed, skipped) = (total.failed.len(), total.skipped.len());
    println!("{} passed, {failed} failed, {skipped} skipped", total.passed);
    if failed == 0 { Exit::Ok } else { Exit::Internal }
}

fn suite(name: &str, command: Command, results: SuiteResults) -> Suite {
    Suite { name: name.to_owned(), action: SuiteAction::Run(Box::new(command), results) }
}

fn has_nextest(checkout: &Checkout) -> bool {
    succeeds(checkout.cargo().args(["nextest", "--version"]))
}

/// Runs tests of the default members, each in a process of its own.
fn nextest(checkout: &Checkout, arguments: &[&str]) -> Suite {
    let mut nextest = checkout.cargo();
    nextest.args(["nextest", "run", "--release"]).args(arguments);
    // With colours, the lines of tests that it skips begin otherwise.
    nextest.env("CARGO_TERM_COLOR", "never");
    onnxruntime::pass_to(checkout, &mut nextest);
    let results = checkout.target().join("nextest/default/junit.xml");
    suite("cargo nextest", nextest, SuiteResults::JUnit(results))
}

/// Returns the command that runs test programs of the default members, one after the other.
fn cargo_test(checkout: &Checkout, arguments: &[&str]) -> Command {
    let mut test = checkout.cargo();
    test.args(["test", "--release", "--no-fail-fast"]).args(arguments);
    test.args(["--", "--show-output"]);
    onnxruntime::pass_to(checkout, &mut test);
    test
}

/// The tests of the default members. To build nextest takes minutes, so it is used where it is
/// installed; cargo alone runs the same tests, one program after the other, so that none of those
/// in real time runs beside another.
fn rust_tests(checkout: &Checkout) -> [Suite; 2] {
    let test = |name: &str, arguments: &[&str]| {
        suite(name, cargo_test(checkout, arguments), SuiteResults::Libtest)
    };
    let tests = if has_nextest(checkout) {
        nextest(checkout, &[])
    } else {
        test("cargo test", &["--lib", "--bins", "--examples", "--tests"])
    };
    // nextest does not run the examples of the documentation.
    [tests, test("cargo test: examples of the documentation", &["--doc"])]
}

fn suites(checkout: &Checkout) -> Vec<Suite> {
    // In a separate target folder, since its flags would recompile everything else.
    let mut loom = checkout.cargo();
    loom.args(["test", "--release", "-p", "gleaner-buffers", "--test", "loom"])
        .env("CARGO_TARGET_DIR", checkout.target().join("loom"))
        .env("RUSTFLAGS", "--cfg loom")
        .env("LOOM_MAX_PREEMPTIONS", "3");

    let mut suites = Vec::from(rust_tests(checkout));
    suites.extend([
        suite(
            "cargo test: bindings of the Rust SDK",
            setup::test_bindings(checkout),
            SuiteResults::Libtest,
        ),
        suite("loom: orders of threads in gleaner-buffers", loom, SuiteResults::Libtest),
        Suite { name: "miri: memory in gleaner-buffers".to_owned(), action: miri(checkout) },
        pytest(checkout, "Python SDK", &["guest-sdk-python/tests"]),
        pytest(checkout, "fleet client", &["fleet-client-python/tests"]),
        // As users test lambdas, with the SDK of this checkout.
        pytest(
            checkout,
            "examples, notebooks and baselines",
            &["examples", "bench/baselines", "bench/analysis"],
        ),
    ]);
    suites.extend(typed(checkout).into_iter().map(|file| {
        let mut mypy = checkout.command(checkout.python());
        mypy.args(["-m", "mypy", "--strict", "--cache-dir"])
            .arg(checkout.target().join("mypy"))
            .arg(&file)
            .env("MYPYPATH", python_path(checkout));
        suite(&format!("mypy: {}", file.display()), mypy, SuiteResults::Status)
    }));
    suites
}

/// The tests in these folders, relative to the checkout, by pytest.
fn pytest(checkout: &Checkout, name: &str, folders: &[&str]) -> Suite {
    let results = checkout.target().join(format!("pytest/{name}.xml"));
    let mut pytest = checkout.command(checkout.python());
    pytest
        .args("-m pytest -q -p no:cacheprovider -p no:logging --junit-xml".split(' '))
        .arg(&results)
        .args(folders)
        .env("GLEANER_EXTENSION", checkout.program("lib_gleaner.so"))
        .env("GLEANER_CLOUD_PROGRAM", checkout.program("gleaner-cloud"))
        .env("PYTHONPATH", python_path(checkout))
        .env("PYTHONDONTWRITEBYTECODE", "1");
    suite(&format!("pytest: {name}"), pytest, SuiteResults::JUnit(results))
}

/// Suites of the player, if it was built: it is not a default member.
fn player_suites(checkout: &Checkout) -> Result<Vec<Suite>, Failure> {
    let name = "cargo test: player";
    if !checkout.program("gleaner-player").is_file() {
        let action = SuiteAction::Skip("no gleaner-player; run: cargo xtask player");
        return Ok(vec![Suite { name: name.to_owned(), action }]);
    }
    // With the features of the whole workspace, and in lints with those of `.ci/run`, so that
    // nothing is built twice.
    let only = ["--release", "--workspace", "--bin", "gleaner-player", "--test", "player"];
    let mut lints = player::cargo(checkout, &player::compiler())?;
    lints.arg("clippy").args(only).args(["--features", LINTED, "--", "-D", "warnings"]);
    let mut tests = player::cargo(checkout, &player::compiler())?;
    tests.arg("test").args(only);
    Ok(vec![
        suite("lints: player", lints, SuiteResults::Status),
        suite(name, tests, SuiteResults::Libtest),
    ])
}

/// Paths that mypy checks, relative to the checkout: the packages, their tests, and each lambda
/// separately, since all are named `main`.
fn typed(checkout: &Checkout) -> Vec<PathBuf> {
    let mains = checkout.lambdas(&FAMILIES).into_iter().map(|lambda| lambda.join("main.py"));
    let mains = mains.filter(|main| checkout.path(main).is_file());
    let packages = [
        "guest-sdk-python/gleaner",
        "guest-sdk-python/tests",
        "fleet-client-python/gleaner_fleet",
        "fleet-client-python/tests",
        "bench/analysis",
    ];
    packages.map(PathBuf::from).into_iter().chain(mains).collect()
}

/// The folders of the Python packages of this checkout.
fn python_path(checkout: &Checkout) -> OsString {
    let folders = ["guest-sdk-python", "fleet-client-python"].map(|it| checkout.path(it));
    env::join_paths(folders).expect("a checkout has no `:` in its path")
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
    SuiteAction::Run(Box::new(tests), SuiteResults::Libtest)
}

impl SuiteAction {
    fn run(self, bounds: &SuiteBounds, output: &mut SuiteOutput) -> TestCounts {
        match self {
            SuiteAction::Skip(why) => {
                output.line(format!("skipped: {why}\n").as_bytes());
                let mut counts = TestCounts::default();
                counts.skip("all", why);
                counts
            }
            SuiteAction::Run(..) if bounds.is_interrupted() => {
                let mut counts = TestCounts::default();
                counts.fail("interrupted before it began");
                counts
            }
            SuiteAction::Run(command, results) => {
                let program = command.get_program().display().to_string();
                if let SuiteResults::JUnit(file) = &results {
                    // That of an earlier run would count.
                    let _ = fs::remove_file(file);
                }
                let mut parser = LibtestParser::default();
                let ended = group::run(*command, bounds, |line| {
                    output.line(line);
                    results.parse_line(&mut parser, String::from_utf8_lossy(line).trim_end());
                });
                let (is_success, status) = match ended {
                    Ok(status) => (status.success(), format!("ended with {status}")),
                    Err(error) => {
                        let status = format!("`{program}` did not run to its end: {error}");
                        // Beside the tests that have failed before.
                        parser.counts.fail(&status);
                        (false, status)
                    }
                };
                results.count(parser, is_success, &status)
            }
        }
    }
}

impl SuiteResults {
    fn parse_line(&self, parser: &mut LibtestParser, line: &str) {
        match self {
            SuiteResults::Libtest => parser.parse_line(line),
            // Only here does nextest name the tests that it skips, such as
            // `SKIP [         ] (───) gleaner-tests::dds a_name [no network]`.
            SuiteResults::JUnit(_) => {
                let skipped = line.trim_start().strip_prefix("SKIP [");
                if let Some((_, name)) = skipped.and_then(|rest| rest.split_once(") ")) {
                    let reason = name.strip_suffix(']').and_then(|name| name.rsplit_once(" ["));
                    let (name, reason) = reason.unwrap_or((name, "ignored"));
                    parser.counts.skip(name, reason);
                }
            }
            SuiteResults::Status => {}
        }
    }

    fn count(&self, mut parser: LibtestParser, is_success: bool, status: &str) -> TestCounts {
        parser.close();
        let mut counts = parser.counts;
        match self {
            SuiteResults::Libtest => {}
            SuiteResults::JUnit(file) => {
                if let Err(error) = junit::add(&mut counts, file) {
                    counts.fail(&format!("{status}; no results in `{}`: {error}", file.display()));
                }
            }
            SuiteResults::Status => counts.passed = u64::from(is_success),
        }
        counts.end(is_success, status);
        counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_suite_beyond_its_time_is_a_failure_with_that_time() {
        let mut command = Command::new("sh");
        command.args(["-c", "echo 'running 1 test'; sleep 600 & sleep 600"]);
        let slow = suite("slow", command, SuiteResults::Libtest);
        let mut output = SuiteOutput { block: Vec::new(), is_shown: false };
        let bounds = SuiteBounds::new(Duration::from_secs(1));
        let counts = slow.action.run(&bounds, &mut output);
        assert!(counts.failed[0].contains("`sh` did not run to its end: not ended after 1s"));
    }
}
