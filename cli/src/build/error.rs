use std::io;
use std::path::PathBuf;
use std::process::ExitStatus;

use gleaner_base::{Exit, Explain, NotPlain};
use gleaner_lambda::layout::{BUILD_MAX, FILES_MAX};
use gleaner_lambda::manifest::Kind;
use gleaner_lambda::{LayoutError, ManifestError};
use gleaner_parts::PartsError;

/// Why a lambda cannot be built.
#[derive(Debug, thiserror::Error)]
pub(super) enum BuildError {
    #[error("`entry` is `{entry}`, and the entry of a {} lambda ends with `.{extension}`", kind.as_str())]
    EntryName { entry: String, kind: Kind, extension: &'static str },
    #[error("`{}`, which {named_by} names, is not there", path.display())]
    Missing { path: PathBuf, named_by: &'static str },
    #[error("there is no `{}`", path.display())]
    NoPackage { path: PathBuf },
    #[error("cannot start `{}`", program.display())]
    NoCargo { program: PathBuf, source: io::Error },
    #[error("the target {TARGET} is not installed")]
    NoTarget,
    #[error("cargo ended with {status}; its messages are above")]
    Compile { status: ExitStatus },
    #[error("cargo ended with {status} in its sandbox; its messages are above")]
    CompileSandboxed { status: ExitStatus },
    #[error("cargo is not sandboxed; gleaner-shim says above what is missing")]
    NoSandbox,
    #[error(
        "what the lambda depends on cannot be fetched: cargo ended with {status}; its messages are above"
    )]
    Fetch { status: ExitStatus },
    #[error("the lambda belongs to the workspace `{}`, and all of that could be read", workspace.display())]
    Workspace { workspace: PathBuf },
    #[error("HOME is no absolute path, and cargo's own folder is not known")]
    NoHome,
    #[error("the toolchain of `{}` is none of rustup's", rustc.display())]
    Toolchain { rustc: PathBuf },
    #[error(transparent)]
    Parts(PartsError),
    #[error("the package `{}` makes no component", package.display())]
    NoComponent { package: PathBuf },
    #[error("cannot {action} `{}`", path.display())]
    File { action: &'static str, path: PathBuf, source: io::Error },
    #[error("it would have more than {FILES_MAX} files, or more than {BUILD_MAX}")]
    TooMuch,
    #[error(transparent)]
    Manifest(ManifestError),
    #[error("`{}` is newer than the build that was just made of it", source_file.display())]
    Changed { source_file: PathBuf },
    #[error("the lambda's files cannot be listed")]
    Sources(#[source] LayoutError),
    #[error("the new build cannot be checked")]
    Layout(#[source] LayoutError),
}

/// What a component is compiled for.
pub(super) const TARGET: &str = "wasm32-wasip2";

impl Explain for BuildError {
    fn help(&self) -> Option<String> {
        Some(match self {
            BuildError::EntryName { kind: Kind::Wasm, .. } => {
                "write entry = \"NAME.wasm\", or kind = \"python\"".to_owned()
            }
            BuildError::EntryName { .. } => "write entry = \"main.py\", or kind = \"wasm\"".to_owned(),
            BuildError::Missing { named_by, .. } => format!("add the file, or correct {named_by} in lambda.toml"),
            BuildError::NoPackage { .. } => {
                "kind = \"wasm\" is a Rust package: `cargo init --lib` makes one; for Python write kind = \"python\""
                    .to_owned()
            }
            BuildError::NoCargo { .. } => "install Rust with rustup, or set CARGO to the cargo to use".to_owned(),
            BuildError::NoTarget => format!("run `rustup target add {TARGET}`"),
            BuildError::NoComponent { .. } => {
                "write crate-type = [\"cdylib\", \"rlib\"] below [lib] in its Cargo.toml".to_owned()
            }
            BuildError::Changed { .. } => {
                "it changed meanwhile: build again; if its date lies in the future, `touch` it first".to_owned()
            }
            BuildError::TooMuch => {
                "keep in the lambda's folder what belongs to it: data that a lambda does not need goes elsewhere"
                    .to_owned()
            }
            BuildError::File { source, .. } => return NotPlain::of(source).map(NotPlain::help),
            BuildError::CompileSandboxed { .. } => {
                "where a build script or a macro was refused something, it was by the layer `files` (all but the toolchain, crates and its \
                 own workspace to read, all but its target folder to write) or `sockets` (any): leave that out, or build without --sandboxed \
                 if you trust its author"
                    .to_owned()
            }
            BuildError::Workspace { .. } => "move the lambda into a folder of its own".to_owned(),
            BuildError::NoHome => "set HOME".to_owned(),
            BuildError::Toolchain { .. } => {
                "remove the rust-toolchain.toml that names it, or name the toolchain: RUSTUP_TOOLCHAIN".to_owned()
            }
            BuildError::Parts(error) => return error.help(),
            BuildError::NoSandbox | BuildError::Fetch { .. } => return None,
            BuildError::Manifest(error) => return error.help(),
            BuildError::Sources(error) | BuildError::Layout(error) => return error.help(),
            BuildError::Compile { .. } => return None,
        })
    }

    fn exit(&self) -> Exit {
        match self {
            BuildError::File { source, .. } if NotPlain::of(source).is_none() => Exit::Internal,
            BuildError::Sources(error) | BuildError::Layout(error) => error.exit(),
            BuildError::Parts(error) => error.exit(),
            BuildError::NoSandbox => Exit::Denied,
            _ => Exit::Usage,
        }
    }
}
