//! Arguments of `gleaner new` and `gleaner build`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use gleaner_lambda::manifest::LambdaKind;

/// Arguments of `gleaner new`.
#[derive(Args, Debug)]
pub struct NewArgs {
    /// The folder to create; its name becomes the name of the lambda
    #[arg(value_name = "DIR")]
    pub path: PathBuf,
    /// The language of the lambda
    #[arg(long, value_enum, default_value = "rust")]
    pub kind: Language,
    /// Only replace the SDK in an existing lambda's folder by that of this gleaner
    #[arg(long, conflicts_with = "kind")]
    pub update: bool,
}

/// Language of a lambda.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Language {
    Rust,
    Python,
}

impl From<Language> for LambdaKind {
    fn from(language: Language) -> Self {
        match language {
            Language::Rust => Self::Wasm,
            Language::Python => Self::Python,
        }
    }
}

/// Arguments of `gleaner build`.
#[derive(Args, Debug, Default)]
pub struct BuildArgs {
    /// Compile a Rust lambda in a sandbox: its build scripts and macros reach no network and only
    /// its own files; also fetch the wheels of a Python lambda in one; see docs/security.md
    #[arg(long)]
    pub sandboxed: bool,
    /// Version of the Python that runs the lambda, such as 3.11, for wheels of its
    /// requirements.txt; by default that of this machine
    #[arg(long, value_name = "3.N")]
    pub python_version: Option<String>,
    /// Platform of that Python, such as manylinux_2_28_aarch64; by default that of this machine
    #[arg(long, value_name = "PLATFORM")]
    pub python_platform: Option<String>,
    /// The lambda's folder, with its lambda.toml
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
}
