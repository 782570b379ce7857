//! `cargo xtask fuzz`: runs libFuzzer on the parsers of untrusted input. `docs/fuzzing.md` lists
//! the tested properties.
//!
//! The stable compiler can instrument code for libFuzzer with the right flags, which `cargo fuzz`
//! also uses. All files are in `fuzz/` and `fuzz-artifacts/` of the target folder.

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
use crate::steps::{self, Steps, cannot};

/// The fuzz targets. Their other properties are in `gleaner-fuzz`, which would take too long to
/// build for this list.
const TARGETS: [&str; 13] = [
    "message", "drive", "bag", "image", "journal", "link", "ingress", "manifest", "trust", "model",
    "spool", "fleet", CALLS,
];

/// The target that runs a lambda. It needs that lambda compiled, and the host, which takes minutes
/// to build.
const CALLS: &str = "calls";
const DRIVER: &str = "tests/lambdas/driver/rust";
/// The cache of its native code, shared with the tests.
const CACHE: &str = "target/test-cache/gleaner";

/// Compiler flags that instrument code edges and comparisons.
const FLAGS: &str = "-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
                     -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
                     -Cllvm-args=-sanitizer-coverage-trace-compares -Cdebug-assertions -Coverflow-checks --cfg fuzzing";

const USAGE: &str = "usage: cargo xtask fuzz [TARGET...] [--seconds N] [--seed N]
targets: message, drive, bag, image, journal, link, ingress, manifest, trust, model, spool, fleet, calls [default: all]
--seconds N  time for each target [default: 60]; targets run in parallel, one per core
--seed N     makes runs of the same programs with the same inputs reproducible";

pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let args = FuzzArgs::of(arguments)?;
    let fuzz = Fuzz {
        checkout,
        build: checkout.target().join("fuzz"),
        findings: checkout.target().join("fuzz-artifacts"),
        seconds: args.seconds,
        seed: args.seed,
    };
    let calls = args.targets.contains(&CALLS);
    let mut steps = Steps::of(3 + usize::from(calls));
    if calls {
        steps.begin("the lambda with random calls (the first time this takes minutes)");
        driver(checkout)?;
    }
    steps.begin("programs, instrumented (the first time this takes minutes)");
    let programs = fuzz.programs(&args.targets)?;
    steps.begin("seed inputs");
    fuzz.seeds()?;
    steps.begin(&format!("{} s for each of: {}", args.seconds, args.targets.join(", ")));
    let found = fuzz.targets(&programs, &args.targets)?;
    Ok(if found == 0 { Exit::Ok } else { Exit::Internal })
}

struct FuzzArgs {
    targets: Vec<&'static str>,
    seconds: u64,
    seed: Option<u64>,
}

impl FuzzArgs {
    fn of(arguments: &[OsString]) -> Result<FuzzArgs, Failure> {
        let refused = |what: String| Failure::new(Exit::Usage, what).with_help(USAGE);
        let mut args = FuzzArgs { targets: Vec::new(), seconds: 60, seed: None };
        let mut words = arguments.iter().map(|argument| argument.to_string_lossy());
        while let Some(word) = words.next() {
            let mut number = || {
                let number = words.next().and_then(|number| number.parse().ok());
                let number = number.filter(|number: &u64| *number > 0);
                number.ok_or_else(|| refused(format!("`{word}` takes a whole number above 0")))
            };
            match &*word {
                "--seconds" => args.seconds = number()?,
                "--seed" => args.seed = Some(number()?),
                name => {
                    let target = TARGETS.into_iter().find(|target| *target == name);
                    let target =
                        target.ok_or_else(|| refused(format!("there is no target `{name}`")))?;
                    if !args.targets.contains(&target) {
                        args.targets.push(target);
                    }
                }
            }
        }
        if args.targets.is_empty() {
            args.targets = TARGETS.to_vec();
        }
        Ok(args)
    }
}

/// Builds the lambda of [`CALLS`], and compiles it for this machine, since the target has no
/// compiler.
pub(crate) fn driver(checkout: &Checkout) -> Result<(), Failure> {
    setup::target(checkout, setup::TARGET)?;
    setup::binaries(checkout, &["gleaner", "gleaner-compile"])?;
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
    /// Builds the programs of these targets; returns their folder.
    fn programs(&self, names: &[&str]) -> Result<PathBuf, Failure> {
        let machine = setup::rustc(self.checkout, &["--print", "host-tuple"])?;
        let mut build = self.checkout.cargo();
        // With an explicit target, the flags do not apply to build scripts.
        build.args(["build", "--profile", "fuzz", "-p", "gleaner-fuzz", "--target", &machine]);
        for name in names {
            build.args(["--bin", &format!("fuzz-{name}")]);
        }
        build.args(["--no-default-features", "--features"]);
        build.arg(if names.contains(&CALLS) { "programs,calls" } else { "programs" });
        build.env("CARGO_TARGET_DIR", &self.build);
        build.env("RUSTFLAGS", FLAGS).env_remove("CARGO_ENCODED_RUSTFLAGS");
        let help =
            "if a C++ compiler is missing, install one (`c++`); else see the first error above";
        steps::run(&mut build, help)?;
        Ok(self.build.join(machine).join("fuzz"))
    }

    fn seeds(&self) -> Result<(), Failure> {
        setup::binaries(self.checkout, &["fuzz-seeds"])?;
        let mut seeds = self.checkout.command(self.checkout.program("fuzz-seeds"));
        steps::run(seeds.arg(self.build.join("seeds")), "see the error above")
    }

    /// Runs the targets in parallel, one single-threaded program per core. Returns the number of
    /// targets with findings.
    fn targets(&self, programs: &Path, names: &[&str]) -> Result<usize, Failure> {
        let left = Mutex::new(names.iter());
        let next = || left.lock().expect("no thread panics with the lock").next();
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

    /// Runs one target and prints a line with the result. Returns whether it found anything.
    fn target(&self, programs: &Path, name: &str) -> Result<bool, Failure> {
        let program = programs.join(format!("fuzz-{name}"));
        let findings = folder(self.findings.join(name))?;
        let log = findings.join("log");
        let longest = self.build.join("seeds").join(format!("{name}.longest"));
        let longest =
            fs::read_to_string(&longest).map_err(|error| cannot("read", &longest, &error))?;
        let output = File::create(&log).map_err(|error| cannot("write", &log, &error))?;
        let mut fuzzer = self.checkout.command(&program);
        // The corpus of earlier runs is kept and extended.
        let seeds = self.build.join("seeds");
        fuzzer.arg(folder(self.build.join("corpus").join(name))?).arg(seeds.join(name));
        fuzzer.arg(option("dict", seeds.join(format!("{name}.dict")).display()));
        fuzzer.arg(option("artifact_prefix", format!("{}/", findings.display())));
        fuzzer.args(self.seed.map(|seed| option("seed", seed)));
        fuzzer.arg(option("max_total_time", self.seconds)).arg(option("max_len", longest.trim()));
        fuzzer.args(["-rss_limit_mb=2048", "-timeout=10", "-print_final_stats=1"]);
        fuzzer.stdin(Stdio::null()).stdout(Stdio::null()).stderr(output);
        let status = fuzzer.status().map_err(|error| cannot("start", &program, &error))?;
        let log_text = fs::read(&log).map_err(|error| cannot("read", &log, &error))?;
        let FuzzStats { executions, reached, input } =
            FuzzStats::of(&String::from_utf8_lossy(&log_text));
        if !status.success() && input.is_none() {
            // The program failed by itself, not because of an input.
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

struct FuzzStats {
    executions: String,
    reached: String,
    input: Option<String>,
}

impl FuzzStats {
    fn of(text: &str) -> FuzzStats {
        let after = |sign: &str| {
            let mut lines = text.lines().rev();
            lines.find_map(|line| {
                Some(line.split_once(sign)?.1.split_whitespace().next()?.to_owned())
            })
        };
        let unknown = || "?".to_owned();
        FuzzStats {
            executions: after("stat::number_of_executed_units:").unwrap_or_else(unknown),
            reached: after(" cov: ").unwrap_or_else(unknown),
            input: after("Test unit written to "),
        }
    }
}

fn option(name: &str, value: impl std::fmt::Display) -> String {
    format!("-{name}={value}")
}

fn folder(path: PathBuf) -> Result<PathBuf, Failure> {
    steps::make_folder(&path).map(|()| path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_are_read_from_the_output() {
        let text = "#2\tINITED cov: 8 ft: 8 corp: 1/1b exec/s: 0 rss: 27Mb\n#9\tDONE   cov: 11 ft: 11\nstat::number_of_executed_units: 9\n";
        let FuzzStats { executions, reached, input } = FuzzStats::of(text);
        assert_eq!((executions.as_str(), reached.as_str(), input), ("9", "11", None));
        let text = "artifact_prefix='x/'; Test unit written to x/crash-1\nBase64: AA==\n";
        let FuzzStats { executions, input, .. } = FuzzStats::of(text);
        assert_eq!((executions.as_str(), input.as_deref()), ("?", Some("x/crash-1")));
    }

    #[test]
    fn arguments_are_targets_a_time_and_a_seed() {
        let args =
            |words: &[&str]| FuzzArgs::of(&words.iter().map(OsString::from).collect::<Vec<_>>());
        let all = args(&[]).unwrap_or_else(|failure| panic!("{failure}"));
        assert_eq!((all.targets.len(), all.seconds), (TARGETS.len(), 60));
        assert_eq!(all.seed, None);
        let some = ["drive", "--seconds", "5", "image", "--seed", "7", "drive"];
        let some = args(&some).unwrap_or_else(|failure| panic!("{failure}"));
        assert_eq!((some.targets, some.seconds, some.seed), (vec!["drive", "image"], 5, Some(7)));
        let wrong = "--seconds 0,--seconds -1,--seed 0,--seed x,drive x,x,--seconds,--seed";
        for wrong in wrong.split(',') {
            let wrong: Vec<_> = wrong.split(' ').collect();
            assert!(args(&wrong).is_err_and(|failure| failure.exit == Exit::Usage), "{wrong:?}");
        }
    }
}
