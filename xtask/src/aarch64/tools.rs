//! Finds the tools to build for aarch64 and to run the programs here: a C compiler, a C library and
//! an emulator.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::setup;
use crate::steps;

/// Name of the compilation target in rustup and cargo.
pub(super) const TARGET: &str = "aarch64-unknown-linux-gnu";

const COMPILER: &str = "aarch64-linux-gnu-gcc";
/// Names of the emulator's program; a distribution installs one or both.
const EMULATORS: [&str; 2] = ["qemu-aarch64-static", "qemu-aarch64"];
const LOADER: &str = "ld-linux-aarch64.so.1";

/// The tools of this machine.
pub(super) struct Tools {
    emulator: &'static str,
    /// The folder above `lib/` of the C library for aarch64.
    libraries: PathBuf,
}

impl Tools {
    /// Finds the tools, and fetches Rust's libraries for the target.
    pub(super) fn find(checkout: &Checkout) -> Result<Tools, Failure> {
        let has = |program: &str| steps::succeeds(checkout.command(program).arg("--version"));
        let emulator = EMULATORS.into_iter().find(|program| has(program));
        let compiler = has(COMPILER);
        let libraries = if compiler { libraries(checkout)? } else { None };
        let packages = [
            (compiler, "gcc-aarch64-linux-gnu"),
            (libraries.is_some(), "libc6-dev-arm64-cross"),
            (emulator.is_some(), "qemu-user-static"),
        ];
        let missing = packages
            .iter()
            .filter(|(is_installed, _)| !is_installed)
            .map(|(_, package)| *package)
            .collect::<Vec<_>>();
        let (Some(emulator), Some(libraries), true) = (emulator, libraries, compiler) else {
            let help =
                format!("on Debian and Ubuntu, as root: apt-get install {}", missing.join(" "));
            return Err(
                Failure::new(Exit::Unreachable, "tools for aarch64 are missing").with_help(help)
            );
        };
        // A failed download is reported as unreachable, unlike a compile error.
        setup::target(checkout, TARGET)
            .map_err(|failure| Failure { exit: Exit::Unreachable, ..failure })?;
        Ok(Tools { emulator, libraries })
    }

    /// Returns the command cargo, with the environment for builds with [`TARGET`].
    pub(super) fn cargo(&self, checkout: &Checkout) -> Command {
        let name = TARGET.replace('-', "_");
        let mut cargo = checkout.cargo();
        cargo
            .env(format!("CARGO_TARGET_{}_LINKER", name.to_uppercase()), COMPILER)
            .env(format!("CC_{name}"), COMPILER);
        // The extension module uses the stable ABI of 3.9, with symbols of the interpreter that
        // loads it, so no Python for aarch64 is needed to build it.
        cargo.env("PYO3_NO_PYTHON", "1");
        cargo
    }

    /// Returns a shell script that runs `program`, built for aarch64, in the emulator.
    pub(super) fn script(&self, program: &Path) -> String {
        format!(
            "#!/bin/sh\nexec {} -L {} {} \"$@\"\n",
            self.emulator,
            quoted(&self.libraries),
            quoted(program)
        )
    }

    /// Returns a shell script that runs `program`, built for this machine.
    pub(super) fn native_script(program: &Path) -> String {
        format!("#!/bin/sh\nexec {} \"$@\"\n", quoted(program))
    }
}

/// Returns the folder above `lib/` of the C library that the C compiler uses; `None` if it has
/// none.
fn libraries(checkout: &Checkout) -> Result<Option<PathBuf>, Failure> {
    let mut compiler = checkout.command(COMPILER);
    let loader =
        steps::output(compiler.arg(format!("-print-file-name={LOADER}")), "see the error above")?;
    // The compiler prints the bare name if it does not find the loader, else FOLDER/lib/LOADER
    // relative to its own folder.
    let loader = Path::new(loader.trim()).canonicalize().ok().filter(|loader| loader.is_file());
    Ok(loader.and_then(|loader| Some(loader.parent()?.parent()?.to_owned())))
}

/// Quotes `path` for a shell.
fn quoted(path: &Path) -> String {
    format!("'{}'", path.display().to_string().replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scripts_quote_paths() {
        let tools = Tools { emulator: "emulator", libraries: "/usr/arm".into() };
        let script = tools.script(Path::new("/it's a/program"));
        assert_eq!(script, "#!/bin/sh\nexec emulator -L '/usr/arm' '/it'\\''s a/program' \"$@\"\n");
    }
}
