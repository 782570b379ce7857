//! Finds the tools to build for aarch64 and to run the programs here: compilers, a C library and an
//! emulator.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::player;
use crate::setup;
use crate::steps;

/// Name of the compilation target in rustup and cargo.
pub(crate) const TARGET: &str = "aarch64-unknown-linux-gnu";

const COMPILER: &str = "aarch64-linux-gnu-gcc";
/// Cyclone DDS, in the player, is C, but its build asks for both.
const CPP_COMPILER: &str = "aarch64-linux-gnu-g++";
/// Packages of both compilers, which need the C library.
const PACKAGES: [&str; 2] = ["g++-aarch64-linux-gnu", "libc6-dev-arm64-cross"];
/// Names of the emulator's program; a distribution installs one or both.
const EMULATORS: [&str; 2] = ["qemu-aarch64-static", "qemu-aarch64"];
const LOADER: &str = "ld-linux-aarch64.so.1";

pub(crate) struct Tools {
    /// The folder above `include/` and `lib/` of the C library for aarch64.
    pub(super) libraries: PathBuf,
}

impl Tools {
    /// Finds the tools, and fetches Rust's libraries for the target.
    pub(crate) fn find(checkout: &Checkout) -> Result<Tools, Failure> {
        if let Some(libraries) = libraries(checkout)? {
            // A failed download is reported as unreachable, unlike a compile error.
            setup::target(checkout, TARGET)
                .map_err(|failure| Failure { exit: Exit::Unreachable, ..failure })?;
            return Ok(Tools { libraries });
        }
        Err(missing("tools for aarch64 are missing", &PACKAGES))
    }

    /// As [`find`](Self::find); installs the tools first, as root, if they are missing.
    pub(crate) fn install(checkout: &Checkout) -> Result<Tools, Failure> {
        if libraries(checkout)?.is_none() {
            steps::install(checkout, &PACKAGES)?;
        }
        Tools::find(checkout)
    }

    /// Returns the command cargo, with the environment for builds with [`TARGET`].
    pub(super) fn cargo(&self, checkout: &Checkout) -> Command {
        let mut cargo = checkout.cargo();
        self.set_environment(&mut cargo);
        cargo
    }

    pub(super) fn cargo_with_player(&self, checkout: &Checkout) -> Result<Command, Failure> {
        let mut cargo = player::cargo(checkout, COMPILER)?;
        self.set_environment(&mut cargo);
        // libclang searches those of this machine's C library otherwise.
        let (compiler, library) =
            (player::headers(checkout, COMPILER)?, self.libraries.join("include"));
        let headers = format!("-I{compiler} -I{}", library.display());
        cargo.env("BINDGEN_EXTRA_CLANG_ARGS", headers);
        Ok(cargo)
    }

    fn set_environment(&self, cargo: &mut Command) {
        let name = TARGET.replace('-', "_");
        cargo
            .env(format!("CARGO_TARGET_{}_LINKER", name.to_uppercase()), COMPILER)
            .env(format!("CC_{name}"), COMPILER)
            .env(format!("CXX_{name}"), CPP_COMPILER);
        // The extension module uses the stable ABI of 3.9, with symbols of the interpreter that
        // loads it, so no Python for aarch64 is needed to build it.
        cargo.env("PYO3_NO_PYTHON", "1");
    }
}

/// Returns the program that runs those of aarch64 on this machine.
pub(super) fn emulator(checkout: &Checkout) -> Result<&'static str, Failure> {
    let program = EMULATORS.into_iter().find(|program| has(checkout, program));
    program.ok_or_else(|| missing("no emulator", &["qemu-user-static"]))
}

fn missing(what: &str, packages: &[&str]) -> Failure {
    Failure::new(Exit::Unreachable, what).with_help(format!(
        "on Debian and Ubuntu, as root: apt-get install {}; `cargo xtask dist --install` installs \
         the compilers",
        packages.join(" ")
    ))
}

fn has(checkout: &Checkout, program: &str) -> bool {
    steps::succeeds(checkout.command(program).arg("--version"))
}

/// Returns the folder above `lib/` of the C library that the C compiler uses; `None` if a compiler
/// or the library is missing.
fn libraries(checkout: &Checkout) -> Result<Option<PathBuf>, Failure> {
    if ![COMPILER, CPP_COMPILER].iter().all(|program| has(checkout, program)) {
        return Ok(None);
    }
    let mut compiler = checkout.command(COMPILER);
    let loader =
        steps::output(compiler.arg(format!("-print-file-name={LOADER}")), "see the error above")?;
    // The compiler prints the bare name if it does not find the loader, else FOLDER/lib/LOADER
    // relative to its own folder.
    let loader = Path::new(loader.trim()).canonicalize().ok().filter(|loader| loader.is_file());
    Ok(loader.and_then(|loader| Some(loader.parent()?.parent()?.to_owned())))
}
