//! `--sandboxed`: building a Rust lambda runs code of its author, build scripts and macros. Here
//! that code can read the toolchain, fetched crates and the workspace of the lambda, and write into
//! a folder of its own, and has no sockets.
//!
//! What it needs from a network is fetched before, which runs none of that code. Cargo is started
//! in the root folder: a configuration or toolchain file beside the lambda, which could name
//! programs to run, is not read. The jail itself is `gleaner-shim --compiler`.

use std::env;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use gleaner_base::{NotPlain, hex, own_file};
use gleaner_parts::Parts;
use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::error::{BuildError, TARGET};

/// Where cargo is started.
const ROOT: &str = "/";

/// The target folder of cargo before it is in its jail: nothing can be written there, whatever
/// links the lambda's own has.
const NOWHERE: &str = "/dev/null/target";

/// What is needed of cargo's own folder: crates, and where they come from. Its credentials are not.
const OF_CARGO: [&str; 4] = ["registry", "git", "config.toml", "config"];

/// How a package is compiled.
pub(super) struct Sandbox {
    shim: PathBuf,
    sysroot: PathBuf,
    cargo_home: PathBuf,
    workspace: PathBuf,
    /// The only folder that is written.
    target: PathBuf,
}

/// What cargo says of a package.
#[derive(Deserialize)]
struct Metadata {
    workspace_root: PathBuf,
}

impl Sandbox {
    /// Fetches what `package`, a `Cargo.toml`, depends on.
    pub(super) fn prepare(package: &Path) -> Result<Self, BuildError> {
        let shim = Parts::find()
            .and_then(|parts| parts.program("gleaner-shim"))
            .map_err(BuildError::Parts)?;
        let home = env::var_os("HOME").map(PathBuf::from).filter(|home| home.is_absolute());
        let home = home.ok_or(BuildError::NoHome)?;
        let sysroot = sysroot(&home)?;
        let Metadata { workspace_root } = metadata(&sysroot, package)?;
        if !package.starts_with(&workspace_root) || home.starts_with(&workspace_root) {
            return Err(BuildError::Workspace { workspace: workspace_root });
        }
        let lock = workspace_root.join("Cargo.lock");
        // Cargo would write to where a link leads, and wait for a pipe.
        match lock.symlink_metadata() {
            Ok(found) if found.is_symlink() => {
                return Err(file("write", &lock)(io::Error::other(NotPlain::Link)));
            }
            Ok(found) if !found.is_file() => {
                return Err(file("write", &lock)(io::Error::other(NotPlain::NoFile)));
            }
            _ => {}
        }
        fetch(&sysroot, package)?;
        // One for each lambda, which else could change what was compiled for another.
        let name = hex(&Sha256::digest(package.as_os_str().as_encoded_bytes())[..8]);
        let all = workspace_root.join("target");
        let sandboxed = all.join("sandboxed");
        let target = sandboxed.join(name);
        for folder in [&all, &sandboxed, &target, &target.join("tmp")] {
            own_file::folder(folder).map_err(file("create", folder))?;
        }
        let target = target.canonicalize().map_err(file("create", &target))?;
        let cargo_home =
            env::var_os("CARGO_HOME").map_or_else(|| home.join(".cargo"), PathBuf::from);
        Ok(Self { shim, sysroot, cargo_home, workspace: workspace_root, target })
    }

    /// Where everything is that the build writes.
    pub(super) fn target(&self) -> &Path {
        &self.target
    }

    /// Cargo, in its jail, for `cargo build`.
    pub(super) fn cargo(&self) -> Command {
        let mut command = Command::new(&self.shim);
        command.arg("--compiler").arg("--write").arg(&self.target);
        let of_cargo = OF_CARGO.map(|name| self.cargo_home.join(name));
        for path in of_cargo.iter().chain([&self.sysroot, &self.workspace]) {
            command.arg("--read").arg(path);
        }
        command.arg("--").arg(program_of(&self.sysroot, "cargo")).arg("build").arg("--offline");
        command.arg("--target-dir").arg(&self.target);
        // Not by way of a wrapper, which is a program of the user's, and may want a socket. That of
        // the workspace is left alone: cargo has it in the names of symbols, be it set to nothing,
        // so that another component would come out.
        command.env("RUSTC", program_of(&self.sysroot, "rustc")).env("RUSTC_WRAPPER", "");
        command
            .env("CARGO_HOME", &self.cargo_home)
            .env("TMPDIR", self.target.join("tmp"))
            .current_dir(ROOT);
        command
    }
}

/// The folder of the compiler that the user has chosen. A toolchain file may name any folder: only
/// what rustup installed is started.
fn sysroot(home: &Path) -> Result<PathBuf, BuildError> {
    let chosen = env::var_os("CARGO").map(PathBuf::from).filter(|cargo| cargo.is_absolute());
    let rustc = match chosen {
        Some(cargo) => cargo.with_file_name("rustc"),
        None => match answer(Command::new("rustup").args(["which", "rustc"])) {
            Ok(rustc) => of_rustup(rustc.into(), home)?,
            // There is no rustup: then no file chooses a compiler.
            Err(_) => "rustc".into(),
        },
    };
    answer(Command::new(&rustc).args(["--print", "sysroot"]).current_dir(ROOT))
        .map(PathBuf::from)
        .map_err(|source| BuildError::NoCargo { program: rustc, source })
}

fn of_rustup(rustc: PathBuf, home: &Path) -> Result<PathBuf, BuildError> {
    let rustup = env::var_os("RUSTUP_HOME").map_or_else(|| home.join(".rustup"), PathBuf::from);
    let is_installed = rustc.starts_with(rustup.join("toolchains"));
    if is_installed { Ok(rustc) } else { Err(BuildError::Toolchain { rustc }) }
}

fn program_of(sysroot: &Path, name: &str) -> PathBuf {
    let program = sysroot.join("bin").join(name);
    if program.is_file() { program } else { name.into() }
}

fn metadata(sysroot: &Path, package: &Path) -> Result<Metadata, BuildError> {
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
    serde_json::from_slice(&output.stdout).map_err(|error| file("read", package)(error.into()))
}

fn fetch(sysroot: &Path, package: &Path) -> Result<(), BuildError> {
    let (cargo, rustc) = (program_of(sysroot, "cargo"), program_of(sysroot, "rustc"));
    let host = answer(Command::new(&rustc).args(["--print", "host-tuple"]).current_dir(ROOT))
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

/// The line that `command` prints.
fn answer(command: &mut Command) -> io::Result<String> {
    let output = command.stdin(Stdio::null()).stderr(Stdio::null()).output()?;
    let line = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    if output.status.success() && !line.is_empty() {
        return Ok(line);
    }
    let program = command.get_program().display().to_string();
    Err(io::Error::other(format!("`{program}` ended with {}", output.status)))
}

fn file(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> BuildError {
    let path = path.to_owned();
    move |source| BuildError::File { action, path, source }
}
