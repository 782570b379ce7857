//! Builds a Rust lambda in a sandbox (`--sandboxed`), since build scripts and macros are code of
//! its author. pip, which fetches the wheels of a Python lambda, has the same one, with a network.
//!
//! The sandbox lets this code read the toolchain, fetched crates and the workspace of the lambda,
//! and write into one folder; it denies sockets. Dependencies are fetched before, which runs none
//! of that code. Cargo starts in the root folder, so that it does not read a configuration or
//! toolchain file beside the lambda, which could name programs to run. The jail itself is
//! `gleaner-shim --compiler`.

use std::env;
use std::ffi::OsStr;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{NotPlain, hex, safe_file};
use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::error::{BuildError, TARGET, failed};

/// Working directory of cargo.
const ROOT: &str = "/";

/// Target folder of cargo outside of the jail. It cannot be written, unlike the lambda's own target
/// folder, which may contain links.
const NOWHERE: &str = "/dev/null/target";

/// Readable parts of cargo's home: crates and the configuration of registries, but no credentials.
const CARGO_HOME_PARTS: [&str; 4] = ["registry", "git", "config.toml", "config"];

pub(super) struct Sandbox {
    shim: PathBuf,
    sysroot: PathBuf,
    cargo_home: PathBuf,
    workspace: PathBuf,
    /// The only writable folder.
    target: PathBuf,
}

#[derive(Deserialize)]
struct CargoMetadata {
    workspace_root: PathBuf,
}

impl Sandbox {
    /// Checks the workspace of `package`, a `Cargo.toml`, and fetches its dependencies.
    pub(super) fn prepare(package: &Path) -> Result<Self, BuildError> {
        let shim = shim()?;
        let home = env::var_os("HOME").map(PathBuf::from).filter(|home| home.is_absolute());
        let home = home.ok_or(BuildError::NoHome)?;
        let sysroot = sysroot(&home)?;
        let CargoMetadata { workspace_root } = metadata(&sysroot, package)?;
        if !package.starts_with(&workspace_root) || home.starts_with(&workspace_root) {
            return Err(BuildError::Workspace { workspace: workspace_root });
        }
        let lock = workspace_root.join("Cargo.lock");
        // Cargo would follow a link and block on a pipe.
        match lock.symlink_metadata() {
            Ok(found) if found.is_symlink() => {
                return Err(failed("write", &lock)(io::Error::other(NotPlain::Link)));
            }
            Ok(found) if !found.is_file() => {
                return Err(failed("write", &lock)(io::Error::other(NotPlain::NoFile)));
            }
            _ => {}
        }
        fetch(&sysroot, package)?;
        // One target folder per lambda, so that a lambda cannot change what another one uses.
        let name = hex(&Sha256::digest(package.as_os_str().as_encoded_bytes())[..8]);
        let all = workspace_root.join("target");
        let sandboxed = all.join("sandboxed");
        let target = sandboxed.join(name);
        for folder in [&all, &sandboxed, &target, &target.join("tmp")] {
            safe_file::folder(folder).map_err(failed("create", folder))?;
        }
        let target = target.canonicalize().map_err(failed("create", &target))?;
        let cargo_home =
            env::var_os("CARGO_HOME").map_or_else(|| home.join(".cargo"), PathBuf::from);
        Ok(Self { shim, sysroot, cargo_home, workspace: workspace_root, target })
    }

    pub(super) fn target(&self) -> &Path {
        &self.target
    }

    pub(super) fn cargo(&self) -> Command {
        let mut command = Command::new(&self.shim);
        command.arg("--compiler").arg("--write").arg(&self.target);
        let home_parts = CARGO_HOME_PARTS.map(|name| self.cargo_home.join(name));
        for path in home_parts.iter().chain([&self.sysroot, &self.workspace]) {
            command.arg("--read").arg(path);
        }
        command.arg("--").arg(program_of(&self.sysroot, "cargo")).arg("build").arg("--offline");
        command.arg("--target-dir").arg(&self.target);
        // No compiler wrapper: it is a program of the user, and may need a socket. A workspace
        // wrapper is left alone: cargo hashes even an empty one into symbol names, which would
        // change the component.
        command.env("RUSTC", program_of(&self.sysroot, "rustc")).env("RUSTC_WRAPPER", "");
        command
            .env("CARGO_HOME", &self.cargo_home)
            .env("TMPDIR", self.target.join("tmp"))
            .current_dir(ROOT);
        command
    }
}

/// Returns the command `python` in the jail of a compiler, but with a network.
pub(super) fn fetcher(
    python: &Path,
    read: &[PathBuf],
    write: [&Path; 2],
) -> Result<Command, BuildError> {
    let mut command = Command::new(shim()?);
    command.args(["--compiler", "--network"]);
    command.args(write.into_iter().flat_map(|path| [OsStr::new("--write"), path.as_os_str()]));
    command.args(read.iter().flat_map(|path| [OsStr::new("--read"), path.as_os_str()]));
    command.arg("--").arg(python);
    Ok(command)
}

fn shim() -> Result<PathBuf, BuildError> {
    InstalledPrograms::find()
        .and_then(|parts| parts.program("gleaner-shim"))
        .map_err(BuildError::InstalledPrograms)
}

/// Returns the sysroot of the compiler that the user has chosen. Only a toolchain that rustup
/// installed is started, since a toolchain file may name any folder.
fn sysroot(home: &Path) -> Result<PathBuf, BuildError> {
    let chosen = env::var_os("CARGO").map(PathBuf::from).filter(|cargo| cargo.is_absolute());
    let rustc = match chosen {
        Some(cargo) => cargo.with_file_name("rustc"),
        None => match first_line(Command::new("rustup").args(["which", "rustc"])) {
            Ok(rustc) => check_rustup(rustc.into(), home)?,
            // Without rustup, no file chooses a compiler.
            Err(_) => "rustc".into(),
        },
    };
    first_line(Command::new(&rustc).args(["--print", "sysroot"]).current_dir(ROOT))
        .map(PathBuf::from)
        .map_err(|source| BuildError::NoCargo { program: rustc, source })
}

fn check_rustup(rustc: PathBuf, home: &Path) -> Result<PathBuf, BuildError> {
    let rustup = env::var_os("RUSTUP_HOME").map_or_else(|| home.join(".rustup"), PathBuf::from);
    let is_installed = rustc.starts_with(rustup.join("toolchains"));
    if is_installed { Ok(rustc) } else { Err(BuildError::Toolchain { rustc }) }
}

fn program_of(sysroot: &Path, name: &str) -> PathBuf {
    let program = sysroot.join("bin").join(name);
    if program.is_file() { program } else { name.into() }
}

fn metadata(sysroot: &Path, package: &Path) -> Result<CargoMetadata, BuildError> {
    let cargo = program_of(sysroot, "cargo");
    let mut command = Command::new(&cargo);
    command
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1", "--manifest-path"])
        .arg(package);
    let output = command
        .env("CARGO_TARGET_DIR", NOWHERE)
        .current_dir(ROOT)
        .stdin(Stdio::null())
        .stderr(Stdio::inherit())
        .output();
    let output = output.map_err(|source| BuildError::NoCargo { program: cargo, source })?;
    if !output.status.success() {
        return Err(BuildError::Compile { status: output.status });
    }
    serde_json::from_slice(&output.stdout).map_err(|error| failed("read", package)(error.into()))
}

fn fetch(sysroot: &Path, package: &Path) -> Result<(), BuildError> {
    let (cargo, rustc) = (program_of(sysroot, "cargo"), program_of(sysroot, "rustc"));
    let host = first_line(Command::new(&rustc).args(["--print", "host-tuple"]).current_dir(ROOT))
        .map_err(|source| BuildError::NoCargo { program: rustc, source })?;
    let mut command = Command::new(&cargo);
    command
        .arg("fetch")
        .arg("--manifest-path")
        .arg(package)
        .args(["--target", TARGET, "--target", &host]);
    command.env("CARGO_TARGET_DIR", NOWHERE);
    let status = command.current_dir(ROOT).stdin(Stdio::null()).status();
    let status = status.map_err(|source| BuildError::NoCargo { program: cargo, source })?;
    if status.success() { Ok(()) } else { Err(BuildError::Fetch { status }) }
}

fn first_line(command: &mut Command) -> io::Result<String> {
    let output = command.stdin(Stdio::null()).stderr(Stdio::null()).output()?;
    let line = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    if output.status.success() && !line.is_empty() {
        return Ok(line);
    }
    let program = command.get_program().display().to_string();
    Err(io::Error::other(format!("`{program}` ended with {}", output.status)))
}
