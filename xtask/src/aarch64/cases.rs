//! Defines the replays, and runs them on this machine and on the emulated one.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Instant;

use gleaner_base::{Exit, Failure};
use gleaner_protocol::{ReplaySummary, Verified};

use super::compare::{ReplayResults, read};
use crate::checkout::Checkout;
use crate::examples::DRIVE;
use crate::private_folder::PrivateFolder;
use crate::steps;

pub(super) const OUT: &str = "out/aarch64";

pub(super) struct ReplayCase {
    lambda: &'static str,
    set: &'static [&'static str],
    /// A limit of the vehicle that is smaller than that of the manifest.
    limit: Option<&'static str>,
    /// End of the replay, in seconds of the drive.
    to: Option<&'static str>,
    deterministic: bool,
    /// Reason why its decisions must differ, which also proves that differences are found.
    pub(super) known_difference: Option<&'static str>,
}

const fn case(lambda: &'static str, set: &'static [&'static str]) -> ReplayCase {
    ReplayCase { lambda, set, limit: None, to: None, deterministic: false, known_difference: None }
}

/// Replays with triggers, all pixels of all pictures, floating point, and every kind of fault that
/// depends on the processor.
pub(super) const CASES: [ReplayCase; 14] = [
    case("examples/hello/rust", &["brake_mps2=-1.4"]),
    case("examples/brake-dark/rust", &["brake_mps2=-1.4", "dark_luma=50"]),
    // Every picture is bright enough, and the car always brakes.
    case("examples/brake-dark/rust", &["brake_mps2=100", "dark_luma=255"]),
    case("tests/lambdas/probe/rust", &["every=1"]),
    case("tests/lambdas/kernels/rust", &[]),
    // A model; emulated, it takes seconds for each frame.
    ReplayCase {
        to: Some("1"),
        ..case(
            "examples/yolo-detector/rust",
            &["classes=person, car, truck, bus", "min_score=0.05"],
        )
    },
    case("tests/lambdas/misbehave/rust", &["behaviour=recurse"]),
    case("tests/lambdas/misbehave/rust", &["behaviour=endless"]),
    case("tests/lambdas/misbehave/rust", &["behaviour=panic"]),
    case("tests/lambdas/misbehave/rust", &["behaviour=memory"]),
    case("tests/lambdas/misbehave/rust", &["behaviour=host_calls"]),
    ReplayCase {
        limit: Some("stack = \"16 KiB\""),
        ..case("tests/lambdas/misbehave/rust", &["behaviour=recurse"])
    },
    ReplayCase {
        known_difference: Some("the NaN of an arithmetic operation has a sign here and none there"),
        ..case("tests/lambdas/misbehave/rust", &["behaviour=nan_bits"])
    },
    ReplayCase {
        deterministic: true,
        ..case("tests/lambdas/misbehave/rust", &["behaviour=nan_bits"])
    },
];

/// The folders of the lambdas in [`CASES`], each once, relative to the checkout.
pub(super) fn lambdas() -> Vec<PathBuf> {
    let mut lambdas = CASES.iter().map(|case| PathBuf::from(case.lambda)).collect::<Vec<_>>();
    lambdas.dedup();
    lambdas
}

/// Programs for one processor.
pub(super) struct Machine<'c> {
    checkout: &'c Checkout,
    name: &'static str,
    programs: PathBuf,
}

impl<'c> Machine<'c> {
    pub(super) fn here(checkout: &'c Checkout) -> Self {
        Self { checkout, name: std::env::consts::ARCH, programs: checkout.target().join("release") }
    }

    /// The emulated machine; `programs` holds a script for each program.
    pub(super) fn emulated(checkout: &'c Checkout, programs: PathBuf) -> Self {
        Self { checkout, name: "aarch64", programs }
    }

    fn program(&self, name: &str) -> Command {
        let mut program = self.checkout.command(self.programs.join(name));
        // Otherwise they would start the programs beside the emulator.
        program.env("GLEANER_HOME", &self.programs).stdin(Stdio::null());
        program
    }

    fn run(&self, mut command: Command) -> Result<Output, Failure> {
        command.output().map_err(|error| {
            let program = command.get_program().display();
            let message = format!("cannot start `{program}` for {}", self.name);
            Failure::caused_by(Exit::Internal, message, &error)
        })
    }

    /// Runs `gleaner --json` and parses its report, whatever its exit code.
    fn report<T: serde::de::DeserializeOwned>(&self, command: Command) -> Result<T, Failure> {
        let output = self.run(command)?;
        serde_json::from_slice(&output.stdout).map_err(|_| {
            let stderr = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            let message = format!("no result on {} ({})", self.name, output.status);
            let mut failure = Failure::new(Exit::Internal, message);
            failure.causes =
                vec![if stderr.is_empty() { "it printed no error".to_owned() } else { stderr }];
            failure
        })
    }
}

impl ReplayCase {
    /// Name of the case: lambda and settings.
    pub(super) fn name(&self) -> String {
        let set: String = self.set.iter().map(|set| format!(" {set}")).collect();
        let limit: String = self.limit.iter().map(|limit| format!(" with {limit}")).collect();
        let deterministic = if self.deterministic { " with deterministic = true" } else { "" };
        format!("{}{set}{limit}{deterministic}", self.lambda.trim_end_matches("/rust"))
    }

    /// The lambda's folder, relative to the checkout; a copy if the case sets `deterministic`.
    fn lambda(&self, checkout: &Checkout) -> Result<PathBuf, Failure> {
        if !self.deterministic {
            return Ok(PathBuf::from(self.lambda));
        }
        let copy = Path::new(OUT).join("deterministic");
        let copied = copy_deterministic(&checkout.path(self.lambda), &checkout.path(&copy));
        copied.map_err(|error| {
            let message = format!("cannot copy `{}` to `{}`", self.lambda, copy.display());
            Failure::caused_by(Exit::Internal, message, &error)
        })?;
        Ok(copy)
    }

    /// The folder of its results on `machine`, relative to the checkout.
    fn out(&self, machine: &Machine<'_>) -> PathBuf {
        let plain =
            |character: char| if character.is_ascii_alphanumeric() { character } else { '-' };
        Path::new(OUT).join(self.name().chars().map(plain).collect::<String>()).join(machine.name)
    }

    /// Replays the sample drive, with a journal.
    pub(super) fn replay(&self, machine: &Machine<'_>) -> Result<ReplayResults, Failure> {
        let out = self.out(machine);
        let folder = machine.checkout.path(&out);
        steps::make_folder(&folder)?;
        let mut replay = machine.program("gleaner");
        replay.arg("replay").arg(self.lambda(machine.checkout)?).args([DRIVE, "--all", "--json"]);
        replay.arg("--out").arg(&out);
        replay.args(self.set.iter().flat_map(|set| ["--set", set]));
        replay.args(self.to.iter().flat_map(|to| ["--to", to]));
        replay.arg("--journal").arg(journal(&out));
        if let Some(limit) = self.limit {
            let vehicle = folder.join("vehicle.toml");
            fs::write(&vehicle, format!("[limits]\n{limit}\n"))
                .map_err(|error| steps::cannot("write", &vehicle, &error))?;
            replay.arg("--vehicle").arg(vehicle);
        }
        let started = Instant::now();
        let summary: ReplaySummary = machine.report(replay)?;
        read(&folder, summary.wakes, started.elapsed().as_secs_f64())
    }

    /// Repeats every decision of `writer`'s journal on `reader`; returns a sentence with their
    /// number.
    pub(super) fn verify(
        &self,
        writer: &Machine<'_>,
        reader: &Machine<'_>,
    ) -> Result<String, Failure> {
        let mut verify = reader.program("gleaner");
        verify.arg("replay").arg(self.lambda(reader.checkout)?).arg(DRIVE);
        verify.arg("--verify").arg(journal(&self.out(writer))).arg("--json");
        let verified: Verified = reader.report(verify)?;
        Ok(format!(
            "and {} decisions of the journal of {} repeated on {}",
            verified.wakes, writer.name, reader.name
        ))
    }
}

fn copy_deterministic(lambda: &Path, copy: &Path) -> std::io::Result<()> {
    let build = copy.join("build");
    steps::copy_files(&lambda.join("build"), &build)?;
    let manifest = fs::read_to_string(lambda.join("build/lambda.toml"))?;
    let manifest = manifest.replace("[lambda]\n", "[lambda]\ndeterministic = true\n");
    // The manifest of the build is written last, since a build must not be older than its source.
    fs::write(copy.join("lambda.toml"), &manifest)?;
    fs::write(build.join("lambda.toml"), &manifest)
}

fn journal(out: &Path) -> PathBuf {
    out.join("wakes.journal")
}

/// Puts code compiled here into the cache of the emulated machine, and checks that it is compiled
/// again instead of loaded. Returns the warning.
pub(super) fn foreign_code(here: &Machine<'_>, there: &Machine<'_>) -> Result<String, Failure> {
    let lambda = CASES[0].lambda;
    // Loading code requires that only this user may write it.
    let cache = PrivateFolder::create("aarch64")?;
    let compile = |machine: &Machine<'_>, folder: &str| -> Result<PathBuf, Failure> {
        let mut compile = machine.program("gleaner-compile");
        let component = machine.checkout.path(lambda).join("build/hello.wasm");
        compile
            .arg(component)
            .arg("--cache")
            .arg(cache.path().join(folder))
            .stderr(Stdio::inherit());
        let output = machine.run(compile)?;
        let entry = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        if output.status.success() {
            Ok(PathBuf::from(entry))
        } else {
            let message = format!("cannot compile for {} ({})", machine.name, output.status);
            Err(Failure::new(Exit::Internal, message))
        }
    };
    // A program uses the folder `gleaner` in `XDG_CACHE_HOME`.
    let (foreign, own) = (compile(here, "here")?, compile(there, "gleaner")?);
    if foreign.file_name() == own.file_name() {
        let message = "code of both processors has the same name in the cache";
        return Err(Failure::new(Exit::Differs, message));
    }
    fs::copy(&foreign, &own)
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot copy code", &error))?;
    let mut replay = there.program("gleaner");
    replay.args(["replay", lambda, DRIVE, "--out"]).arg(cache.path().join("out"));
    replay.env("XDG_CACHE_HOME", cache.path());
    let output = there.run(replay)?;
    let stderr = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    if !output.status.success() || !stderr.contains("native code in the cache is damaged") {
        let message = format!("code of {} was not replaced on {}", here.name, there.name);
        let mut failure = Failure::new(Exit::Differs, message);
        failure.causes = vec![format!("it ended with {}: {stderr}", output.status)];
        return Err(failure);
    }
    Ok(stderr)
}
