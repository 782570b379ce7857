//! Errors of building a lambda, with help for the user.

use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitStatus;

use gleaner_base::programs::InstallationError;
use gleaner_base::{Exit, Explain, NotPlain, excerpt};
use gleaner_lambda::layout::{BUILD_MAX, FILES_MAX};
use gleaner_lambda::manifest::LambdaKind;
use gleaner_lambda::{LayoutError, ManifestError};
use gleaner_supervisor::wheels::WheelError;

use super::requirements::RefusedLine;

#[derive(Debug, thiserror::Error)]
pub(super) enum BuildError {
    #[error(
        "`entry` is `{entry}`, and the entry of a {} lambda ends with `.{extension}`",
        kind.as_str()
    )]
    EntryName { entry: String, kind: LambdaKind, extension: &'static str },
    #[error("`{}` ({named_by} in lambda.toml) does not exist", path.display())]
    Missing { path: PathBuf, named_by: &'static str },
    #[error("`{}` does not exist", path.display())]
    NoPackage { path: PathBuf },
    #[error("cannot start `{}`", program.display())]
    NoCargo { program: PathBuf, source: io::Error },
    #[error("the target {TARGET} is not installed")]
    NoTarget,
    #[error("cargo ended with {status}; its messages are above")]
    Compile { status: ExitStatus },
    #[error("cargo ended with {status} in its sandbox; its messages are above")]
    CompileSandboxed { status: ExitStatus },
    #[error("the build cannot be sandboxed; the message of gleaner-shim above names the cause")]
    NoSandbox,
    #[error(
        "cannot fetch the dependencies of the lambda: cargo ended with {status}; its messages are \
         above"
    )]
    Fetch { status: ExitStatus },
    #[error(
        "the lambda belongs to the workspace `{}`, which the build could read completely",
        workspace.display()
    )]
    Workspace { workspace: PathBuf },
    #[error("cannot find cargo's folder: HOME is not an absolute path")]
    NoHome,
    #[error("the toolchain of `{}` was not installed by rustup", rustc.display())]
    Toolchain { rustc: PathBuf },
    #[error(transparent)]
    InstalledPrograms(InstallationError),
    #[error("`{text}` is not the platform of a Python on Linux")]
    Platform { text: String },
    #[error("`{}`, line {}: `{}` {}", path.display(), it.number, excerpt(&it.text), it.reason)]
    Requirement { path: PathBuf, it: RefusedLine },
    #[error("pip did not fetch the wheels: it ended with {status}")]
    Fetched { status: ExitStatus },
    #[error("wheel `{wheel}` has the SHA-256 {sha256}, which `{}` does not list", path.display())]
    Unlocked { wheel: String, sha256: String, path: PathBuf },
    #[error("`{}` locks no numpy, which every Python lambda needs", path.display())]
    NoNumpy { path: PathBuf },
    #[error(transparent)]
    Wheel(WheelError),
    #[error("the package `{}` does not build a component", package.display())]
    NoComponent { package: PathBuf },
    #[error("cannot {action} `{}`", path.display())]
    File { action: &'static str, path: PathBuf, source: io::Error },
    #[error("the build has more than {FILES_MAX} files, or more than {BUILD_MAX}")]
    TooMuch,
    #[error(transparent)]
    Manifest(ManifestError),
    #[error("`{}` is newer than the build just made from it", source_file.display())]
    Changed { source_file: PathBuf },
    #[error("cannot list the files of the lambda")]
    Sources(#[source] LayoutError),
    #[error("cannot check the new build")]
    Layout(#[source] LayoutError),
}

pub(super) const TARGET: &str = "wasm32-wasip2";

/// Returns a function that makes an error of `action` on `path`.
pub(super) fn failed(
    action: &'static str,
    path: &Path,
) -> impl Fn(io::Error) -> BuildError + use<> {
    let path = path.to_owned();
    move |source| BuildError::File { action, path: path.clone(), source }
}

impl Explain for BuildError {
    fn help(&self) -> Option<String> {
        let help = match self {
            BuildError::EntryName { kind: LambdaKind::Wasm, .. } => {
                "write entry = \"NAME.wasm\", or kind = \"python\""
            }
            BuildError::EntryName { .. } => "write entry = \"main.py\", or kind = \"wasm\"",
            BuildError::Missing { named_by, .. } => {
                return Some(format!("create the file, or correct {named_by} in lambda.toml"));
            }
            BuildError::NoPackage { .. } => {
                "kind = \"wasm\" needs a Rust package: create one with `cargo init --lib`; \
                 for Python write kind = \"python\""
            }
            BuildError::NoCargo { .. } => {
                "install Rust with rustup, or set CARGO to the cargo to use"
            }
            BuildError::NoTarget => return Some(format!("run `rustup target add {TARGET}`")),
            BuildError::NoComponent { .. } => {
                "write crate-type = [\"cdylib\", \"rlib\"] below [lib] in its Cargo.toml"
            }
            BuildError::Changed { .. } => {
                "it was changed during the build: build again; if its date is in the future, \
                 `touch` it first"
            }
            BuildError::TooMuch => "move data that the lambda does not need out of its folder",
            BuildError::File { source, .. } => return NotPlain::of(source).map(NotPlain::help),
            BuildError::CompileSandboxed { .. } => {
                "if a build script or a macro was denied an access: the layer `files` lets it read \
                 the toolchain, crates and its workspace, and write its target folder; the layer \
                 `sockets` lets it open none. Remove that access, or build without --sandboxed if \
                 you trust the author"
            }
            BuildError::Workspace { .. } => {
                "move the lambda into its own folder outside of the workspace"
            }
            BuildError::NoHome => "set HOME to an absolute path",
            BuildError::Toolchain { .. } => {
                "remove the rust-toolchain.toml that names it, or set RUSTUP_TOOLCHAIN"
            }
            BuildError::InstalledPrograms(error) => return error.help(),
            BuildError::Wheel(error) => return error.help(),
            BuildError::Platform { .. } => {
                "write the version of its glibc and its processor: --python-platform \
                 manylinux_2_28_aarch64; `ldd --version` on the vehicle shows that of its glibc"
            }
            BuildError::Requirement { .. } => {
                "write NAME==VERSION --hash=sha256:HEX, as `pip-compile --generate-hashes` and `uv \
                 pip compile --generate-hashes` do; an index is a setting of the user who builds: \
                 PIP_INDEX_URL"
            }
            BuildError::Fetched { .. } => {
                "its messages are above; only wheels are used. Without pip: install python3-pip, \
                 or name a Python that has it: GLEANER_PYTHON"
            }
            BuildError::Unlocked { .. } => "lock its hashes again, and build again",
            BuildError::NoNumpy { .. } => {
                "add numpy to the requirements, and lock them again; packages of the vehicle are \
                 not visible to a lambda with wheels"
            }
            BuildError::Manifest(error) => return error.help(),
            BuildError::Sources(error) | BuildError::Layout(error) => return error.help(),
            BuildError::NoSandbox | BuildError::Fetch { .. } | BuildError::Compile { .. } => {
                return None;
            }
        };
        Some(help.to_owned())
    }

    fn exit(&self) -> Exit {
        match self {
            BuildError::File { source, .. } if NotPlain::of(source).is_none() => Exit::Internal,
            BuildError::Sources(error) | BuildError::Layout(error) => error.exit(),
            BuildError::InstalledPrograms(error) => error.exit(),
            BuildError::Wheel(error) => error.exit(),
            BuildError::NoSandbox => Exit::Denied,
            _ => Exit::Usage,
        }
    }
}
