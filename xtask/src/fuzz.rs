//! `cargo xtask fuzz`: feeds what reads foreign bytes with bytes that libFuzzer makes up, guided by
//! what code they reach. `docs/fuzzing.md` says what is promised.
//!
//! The stable compiler can instrument code for libFuzzer if it is told so in its own words, which
//! is what `cargo fuzz` does too. All that is made lies in `fuzz/` and `fuzz-artifacts/` of the
//! target folder.

use std::ffi::OsString;
use std::fs::{self, File};
use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::Mutex;
use std::thread;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::setup;
use crate::steps::{self, Steps};

/// The targets. The rest about them is known to `gleaner-fuzz`, which would take too long to be
/// built for this.
const TARGETS: [&str; 8] =
    ["message", "drive", "bag", "image", "journal", "link", "manifest", CALLS];

/// The target that runs a lambda. It needs that lambda compiled, and the host, which takes minutes
/// to be built.
const CALLS: &str = "calls";
/// The lambda of [`CALLS`], and where its native code is kept, as for tests.
const DRIVER: &str = "tests/lambdas/driver/rust";
const CACHE: &str = "target/test-cache/gleaner";

/// How the compiler counts which code was reached, and what was compared with what.
const FLAGS: &str = "-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
                     -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
                     -Cllvm-args=-sanitizer-coverage-trace-compares -Cdebug-assertions -Coverflow-checks --cfg fuzzing";

const USAGE: &str = "usage: cargo xtask fuzz [TARGET...] [--seconds N] [--seed N]
targets: message, drive, bag, image, journal, link, manifest, calls; those named, or all, for N seconds each (60),
as many at once as there are cores.
With a seed, runs of the same programs from the same inputs go the same way.";

/// Builds the targets and runs those asked for.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let asked = Asked::of(arguments)?;
    let fuzz = Fuzz {
        checkout,
        build: checkout.target().join("fuzz"),
        findings: checkout.target().join("fuzz-artifacts"),
        seconds: asked.seconds,
        seed: asked.seed,
    };
    let calls = asked.targets.contains(&CALLS);
    let mut steps = Steps::of(3 + usize::from(calls));
    if calls {
        steps.begin("the lambda whose calls are made up (the first time this takes minutes)");
        driver(checkout)?;
    }
    steps.begin("programs, instrumented (the first time this takes minutes)");
    let programs = fuzz.programs(&asked.targets)?;
    steps.begin("inputs to begin with");
    fuzz.seeds()?;
    steps.begin(&format!("{} s for each of: {}", asked.seconds, asked.targets.join(", ")));
    let found = fuzz.targets(&programs, &asked.targets)?;
    Ok(if found == 0 { Exit::Ok } else { Exit::Internal })
}

struct Asked {
    /// Each once.
    targets: Vec<&'static str>,
    seconds: u64,
    seed: Option<u64>,
}

impl Asked {
    fn of(arguments: &[OsString]) -> Result<Asked, Failure> {
        let refused = |what: String| Failure::new(Exit::Usage, what).with_help(USAGE);
        let mut asked = Asked { targets: Vec::new(), seconds: 60, seed: None };
        let mut words = arguments.iter().map(|argument| argument.to_string_lossy());
        while let Some(word) = words.next() {
            if word == "--seconds" {
                let seconds = words
                    .next()
                    .and_then(|seconds| seconds.parse().ok())
                    .filter(|seconds| *seconds > 0);
                asked.seconds = seconds
                    .ok_or_else(|| refused("`--seconds` takes a whole number".to_owned()))?;
            } else if word == "--seed" {
                let seed = words.next().and_then(|seed| seed.parse().ok()).filter(|seed| *seed > 0);
                asked.seed =
                    Some(seed.ok_or_else(|| {
                        refused("`--seed` takes a whole number above 0".to_owned())
                    })?);
            } else {
                let target = TARGETS.into_iter().find(|name| *name == word);
                let target =
                    target.ok_or_else(|| refused(format!("there is no target `{word}`")))?;
                if !asked.targets.contains(&target) {
                    asked.targets.push(target);
                }
            }
        }
        if asked.targets.is_empty() {
            asked.targets = TARGETS.to_vec();
        }
        Ok(asked)
    }
}

/// Builds the lambda of [`CALLS`], and compiles it for this machine: the target has no compiler in
/// it.
pub(crate) fn driver(checkout: &Checkout) -> Result<(), Failure> {
    setup::target(checkout, setup::TARGET)?;
    // Of all that is built by default, as there, so that nothing is built twice.
    let mut build = checkout.cargo();
    build.args(["build", "--release", "--bin", "gleaner", "--bin", "gleaner-compile"]);
    steps::run(
        &mut build,
        "if a linker or a C compiler is missing, install one (`cc`); else see the first error above",
    )?;
    setup::build_lambdas(checkout, &[PathBuf::from(DRIVER)])?;
    let mut compile = checkout.command(checkout.program("gleaner-compile"));
    let code = checkout.path(DRIVER).join("build/driver.wasm");
    steps::run(compile.arg(code).arg("--cache").arg(checkout.path(CACHE)), "see the error above")
}

struct Fuzz<'c> {
    checkout: &'c Checkout,
    build: PathBuf,
    findings: PathBuf,
    seconds: u64,
    seed: Option<u64>,
}

impl Fuzz<'_> {
    /// Builds the programs of these targets; returns where they are.
    fn programs(&self, names: &[&str]) -> Result<PathBuf, Failure> {
        let mut rustc =
            self.checkout.command(std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()));
        let machine =
            steps::output(rustc.args(["--print", "host-tuple"]), "install Rust with rustup")?;
        let machine = machine.trim();
        let mut build = self.checkout.cargo();
        // With a target named, flags are for it alone, and not for the programs that run while
        // building.
        build.args(["build", "--release", "-p", "gleaner-fuzz", "--target", machine]);
        for name in names {
            build.args(["--bin", &format!("fuzz-{name}")]);
        }
        build.args([
            "--features",
            if names.contains(&CALLS) { "programs,calls" } else { "programs" },
        ]);
        build
            .env("CARGO_TARGET_DIR", &self.build)
            .env("RUSTFLAGS", FLAGS)
            .env_remove("CARGO_ENCODED_RUSTFLAGS");
        steps::run(
            &mut build,
            "if a C++ compiler is missing, install one (`c++`); else see the first error above",
        )?;
        Ok(self.build.join(machine).join("release"))
    }

    fn seeds(&self) -> Result<(), Failure> {
        let mut build = self.checkout.cargo();
        // With the features of all that is built by default, as there, so that nothing is built
        // twice.
        build.args([
            "build",
            "--release",
            "--workspace",
            "--exclude",
            "gleaner-player",
            "--bin",
            "fuzz-seeds",
        ]);
        steps::run(&mut build, "see the first error above")?;
        let mut seeds = self.checkout.command(self.checkout.program("fuzz-seeds"));
        steps::run(seeds.arg(self.build.join("seeds")), "see the error above")
    }

    /// Runs these, as many at once as there are cores: each is one thread. How many found
    /// something.
    fn targets(&self, programs: &Path, names: &[&str]) -> Result<usize, Failure> {
        let left = Mutex::new(names.iter());
        let next = || left.lock().expect("nobody panics here").next();
        let cores = thread::available_parallelism().map_or(1, NonZero::get);
        thread::scope(|scope| {
            let work = || {
                let mut found = 0;
                while let Some(name) = next() {
                    found += usize::from(self.target(programs, name)?);
                }
                Ok(found)
            };
            let workers: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
            workers.into_iter().map(|worker| worker.join().expect("a worker does not panic")).sum()
        })
    }

    /// Runs one target and says how it went, in a line. Whether it found anything.
    fn target(&self, programs: &Path, name: &str) -> Result<bool, Failure> {
        let program = programs.join(format!("fuzz-{name}"));
        let findings = folder(self.findings.join(name))?;
        let log = findings.join("log");
        let longest = self.build.join("seeds").join(format!("{name}.longest"));
        let longest =
            fs::read_to_string(&longest).map_err(|error| cannot("read", &longest, &error))?;
        let output = File::create(&log).map_err(|error| cannot("write", &log, &error))?;
        let mut fuzzer = self.checkout.command(&program);
        // What was reached in earlier runs is kept, and is where the next one begins.
        fuzzer
            .arg(folder(self.build.join("corpus").join(name))?)
            .arg(self.build.join("seeds").join(name));
        fuzzer.arg(option("dict", self.build.join("seeds").join(format!("{name}.dict")).display()));
        fuzzer.arg(option("artifact_prefix", format!("{}/", findings.display())));
        fuzzer.args(self.seed.map(|seed| option("seed", seed)));
        fuzzer.arg(option("max_total_time", self.seconds)).arg(option("max_len", longest.trim()));
        fuzzer.args(["-rss_limit_mb=2048", "-timeout=10", "-print_final_stats=1"]);
        fuzzer.stdin(Stdio::null()).stdout(Stdio::null()).stderr(output);
        let status = fuzzer.status().map_err(|error| cannot("start", &program, &error))?;
        let said = fs::read(&log).map_err(|error| cannot("read", &log, &error))?;
        let Said { executions, reached, input } = Said::of(&String::from_utf8_lossy(&said));
        if !status.success() && input.is_none() {
            // It ended by itself, without having looked for anything.
            let what = format!("`{}` ended with {status}", program.display());
            return Err(
                Failure::new(Exit::Internal, what).with_help(format!("see {}", log.display()))
            );
        }
        let found = if input.is_some() { "A FINDING" } else { "nothing found" };
        println!("{name:<9} {executions:>12} executions {reached:>6} edges reached  {found}");
        if let Some(input) = &input {
            println!(
                "  input: {input}\n  log:   {}\n  again: {} {input}",
                log.display(),
                program.display()
            );
        }
        Ok(input.is_some())
    }
}

/// What libFuzzer says of a run.
struct Said {
    executions: String,
    reached: String,
    /// Where the input lies that broke a promise.
    input: Option<String>,
}

impl Said {
    fn of(text: &str) -> Said {
        let behind = |sign: &str| {
            let mut lines = text.lines().rev();
            lines.find_map(|line| {
                Some(line.split_once(sign)?.1.split_whitespace().next()?.to_owned())
            })
        };
        let unknown = || "?".to_owned();
        Said {
            executions: behind("stat::number_of_executed_units:").unwrap_or_else(unknown),
            reached: behind(" cov: ").unwrap_or_else(unknown),
            input: behind("Test unit written to "),
        }
    }
}

fn option(name: &str, value: impl std::fmt::Display) -> String {
    format!("-{name}={value}")
}

fn folder(path: PathBuf) -> Result<PathBuf, Failure> {
    fs::create_dir_all(&path).map_err(|error| cannot("make folder", &path, &error))?;
    Ok(path)
}

fn cannot(what: &str, path: &Path, error: &std::io::Error) -> Failure {
    Failure::caused_by(Exit::Internal, format!("cannot {what} `{}`", path.display()), error)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_fuzzer_says_is_put_into_a_line() {
        let text = "#2\tINITED cov: 8 ft: 8 corp: 1/1b exec/s: 0 rss: 27Mb\n#9\tDONE   cov: 11 ft: 11\nstat::number_of_executed_units: 9\n";
        let Said { executions, reached, input } = Said::of(text);
        assert_eq!((executions.as_str(), reached.as_str(), input), ("9", "11", None));
        let text = "artifact_prefix='x/'; Test unit written to x/crash-1\nBase64: AA==\n";
        let Said { executions, input, .. } = Said::of(text);
        assert_eq!((executions.as_str(), input.as_deref()), ("?", Some("x/crash-1")));
    }

    #[test]
    fn targets_a_time_and_a_seed_can_be_asked_for() {
        let asked =
            |words: &[&str]| Asked::of(&words.iter().map(OsString::from).collect::<Vec<_>>());
        let all = asked(&[]).unwrap_or_else(|failure| panic!("{failure}"));
        assert_eq!((all.targets.len(), all.seconds), (TARGETS.len(), 60));
        assert_eq!(all.seed, None);
        let some = ["drive", "--seconds", "5", "image", "--seed", "7", "drive"];
        let some = asked(&some).unwrap_or_else(|failure| panic!("{failure}"));
        assert_eq!((some.targets, some.seconds, some.seed), (vec!["drive", "image"], 5, Some(7)));
        let nonsense = [
            ["--seconds", "0"],
            ["--seconds", "-1"],
            ["--seed", "0"],
            ["--seed", "x"],
            ["drive", "x"],
        ];
        for wrong in
            nonsense.iter().map(|wrong| &wrong[..]).chain([&["x"][..], &["--seconds"], &["--seed"]])
        {
            assert!(asked(wrong).is_err_and(|failure| failure.exit == Exit::Usage), "{wrong:?}");
        }
    }
}
