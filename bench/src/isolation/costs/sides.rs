//! The ways to run the same lambda. Programs that users run replay the product's kinds; this
//! program replays the others, in a process of its own, with the product's code around the guest.

use std::ffi::OsString;
use std::path::Path;
use std::process::{Command, ExitCode};

use clap::ValueEnum;
use gleaner_base::{Exit, Failure};
use gleaner_host::guest::Guest;
use gleaner_host::guest::wasm::{Loaded, WasmGuest};
use gleaner_host::program;
use gleaner_lambda::Decision;
use gleaner_tests::live::decisions;
use gleaner_tests::{TempFolder, runtime};
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;

use super::native::NativeGuest;
use crate::kernels::EngineChecks;
use crate::measure::Twin;

/// A guest that the product does not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BenchGuest {
    /// A native function.
    Native,
    /// A component without checks.
    Unchecked,
    /// A component that counts only fuel.
    Fuel,
    /// A component that checks only epochs.
    Epochs,
}

/// A way to run a lambda.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum WakeSide {
    Bench(BenchGuest),
    Product(Twin),
}

/// One replay of a lambda.
pub(super) struct WakeTurn {
    pub(super) decisions: Vec<Decision>,
    /// CPU time of all of its processes.
    pub(super) cpu_us: f64,
}

impl WakeSide {
    pub(super) const NATIVE: Self = Self::Bench(BenchGuest::Native);
    pub(super) const WASM: Self = Self::Product(Twin::Rust);
    pub(super) const PYTHON: Self = Self::Product(Twin::Python);
    pub(super) const UNCHECKED: Self = Self::Bench(BenchGuest::Unchecked);
    pub(super) const FEWER: [Self; 4] = [Self::NATIVE, Self::UNCHECKED, Self::WASM, Self::PYTHON];
    pub(super) const ALL: [Self; 6] = [
        Self::NATIVE,
        Self::UNCHECKED,
        Self::Bench(BenchGuest::Fuel),
        Self::Bench(BenchGuest::Epochs),
        Self::WASM,
        Self::PYTHON,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Bench(BenchGuest::Native) => "native function",
            Self::Bench(BenchGuest::Unchecked) => "wasm without checks",
            Self::Bench(BenchGuest::Fuel) => "wasm, fuel only",
            Self::Bench(BenchGuest::Epochs) => "wasm, epochs only",
            Self::Product(Twin::Rust) => "wasm",
            Self::Product(Twin::Python) => "Python",
        }
    }

    /// The version of the lambda that it runs.
    pub(super) fn twin(self) -> Twin {
        match self {
            Self::Bench(_) => Twin::Rust,
            Self::Product(twin) => twin,
        }
    }

    /// Returns whether its processes compile nothing, which would be most of their CPU time.
    pub(super) fn has_own_cpu(self) -> bool {
        matches!(self, Self::Product(_) | Self::Bench(BenchGuest::Native))
    }

    /// Replays `lambda` over `drive`, with further arguments.
    ///
    /// # Panics
    ///
    /// If the replay fails.
    pub(super) fn replay(self, lambda: &Path, drive: &Path, arguments: &[&str]) -> WakeTurn {
        let out = TempFolder::new();
        let mut replay = match self {
            Self::Product(_) => runtime(),
            Self::Bench(guest) => {
                let this = std::env::current_exe().expect("a program has a path");
                let mut replay = Command::new(this);
                let guest = guest.to_possible_value().expect("no guest is hidden");
                replay.arg("guest").arg(guest.get_name());
                replay
            }
        };
        replay.arg("replay").arg(lambda).arg(drive).args(["--all", "--no-record"]).args(arguments);
        replay.arg("--out").arg(out.path());
        let before = cpu_us_of_children();
        let output = replay.output().expect("the program starts");
        let cpu_us = cpu_us_of_children() - before;
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}: {stderr}", self.name());
        WakeTurn { decisions: decisions(out.path()), cpu_us }
    }
}

/// CPU time of all children that have ended, with that of their own children.
fn cpu_us_of_children() -> f64 {
    let usage = getrusage(UsageWho::RUSAGE_CHILDREN).expect("a process has children");
    (usage.user_time() + usage.system_time()).num_microseconds() as f64
}

/// Runs as `gleaner-runtime` with these arguments, and with a guest that the product does not have.
pub fn run_as_runtime(guest: BenchGuest, arguments: Vec<OsString>) -> ExitCode {
    let arguments = [OsString::from("gleaner-runtime")].into_iter().chain(arguments).collect();
    let code = program::run_with(arguments, &mut |lambda, manifest, session, _| {
        let checks = match guest {
            BenchGuest::Native => {
                let native = NativeGuest::new(manifest.lambda.name.as_str(), session);
                return Ok(Box::new(native) as Box<dyn Guest>);
            }
            BenchGuest::Unchecked => EngineChecks::NONE,
            BenchGuest::Fuel => EngineChecks::FUEL,
            BenchGuest::Epochs => EngineChecks::EPOCHS,
        };
        let path = lambda.build.entry_path(manifest);
        let failed = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, "cannot load the lambda without checks", error)
        };
        let loaded = Loaded::with_checks(&path, &checks.compile(&path), checks.fuel)
            .map_err(|error| failed(&error))?;
        let guest = WasmGuest::new(loaded, session, &manifest.limits, None);
        Ok(Box::new(guest.map_err(|error| failed(&error))?))
    });
    code.into()
}
