//! The WebAssembly engine of all lambdas, and the native code of their components.
//!
//! Compiling takes a second and 40 MB; loading takes 0.3 ms and 11 MB, with a check of 0.2 ms. So a
//! component is compiled once, in a separate process (`gleaner-compile`), and every runtime loads
//! the result from the store of `gleaner-artifacts`. Loading native code means trusting it: the
//! store checks its owner, and that it was made from this component, by this version of wasmtime,
//! the settings below and this CPU. Components are untrusted, so compiling has a memory and a time
//! limit.

use std::io;
use std::path::{Path, PathBuf};

use gleaner_artifacts::{DerivedEntry, DerivedKey, DerivedKind, StoreError};
use gleaner_base::{Exit, Explain, NotPlain, PlainFile, chain};
use gleaner_lambda::layout::COMPONENT_MAX;
use wasmtime::{Config, Engine};

/// Maximum size of native code, in bytes.
pub const CODE_BYTES: usize = DerivedKind::NativeCode.max_bytes();

/// Maximum memory for compiling, in bytes. An ordinary lambda takes some 50 MB, but even a small
/// hostile component can take any amount.
pub const COMPILE_MEMORY_BYTES: u64 = 2 << 30;

/// Maximum CPU time for compiling, in seconds. An ordinary lambda takes one.
pub const COMPILE_CPU_SECONDS: u64 = 120;

/// Maximum stack of a guest, in bytes. Its thread needs some more.
pub const GUEST_STACK_BYTES: usize = 512 << 10;

/// The bits of NaNs that a component computes.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub enum Nans {
    /// The bits that the CPU produces, as WebAssembly allows. Only code that reads the bits can see
    /// a difference.
    #[default]
    Native,
    /// The same bits on every CPU. Spectra take more than twice the time, see `bench/README.md`.
    Canonical,
}

impl Nans {
    /// Returns wasmtime's version and the settings of [`engine`], as text. A change of either
    /// invalidates all native code.
    pub const fn settings(self) -> &'static str {
        match self {
            Self::Native => "wasmtime 48.0.8, fuel, epochs, speed, 1",
            Self::Canonical => "wasmtime 48.0.8, fuel, epochs, speed, canonical NaNs, 1",
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum CompileError {
    #[error("cannot read component `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("component `{}` has {bytes} bytes; the maximum is {COMPONENT_MAX}", path.display())]
    TooLarge { path: PathBuf, bytes: u64 },
    #[error("`{}` is not a WebAssembly component: {}", path.display(), why.reason())]
    NoComponent { path: PathBuf, why: NoComponent },
    #[error("cannot compile component `{}`", path.display())]
    Compile { path: PathBuf, source: Box<dyn std::error::Error + Send + Sync> },
    #[error(
        "component `{}` compiles to {bytes} bytes of native code; the maximum is {CODE_BYTES}",
        path.display()
    )]
    CodeTooLarge { path: PathBuf, bytes: usize },
    #[error("cannot set up the engine")]
    Engine { source: Box<dyn std::error::Error + Send + Sync> },
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// Content of a file that is not a component, by its first bytes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum NoComponent {
    /// Other bytes than those of WebAssembly.
    Foreign,
    /// A module without the interface of a component.
    Module,
}

impl NoComponent {
    /// Checks the first bytes of a component; `None` if they can be those of one.
    #[cfg(feature = "compiler")]
    pub(crate) fn of(bytes: &[u8]) -> Option<Self> {
        match bytes.get(..8) {
            Some(b"\0asm\x01\0\0\0") => Some(Self::Module),
            Some([0, b'a', b's', b'm', ..]) => None,
            _ => Some(Self::Foreign),
        }
    }

    fn reason(self) -> &'static str {
        match self {
            Self::Foreign => "its first bytes are not those of WebAssembly",
            Self::Module => "it is a core module, without the types of a component",
        }
    }

    fn help(self) -> &'static str {
        match self {
            Self::Foreign => {
                "set `entry` in lambda.toml to the component, and build the lambda: \
                 gleaner build DIR"
            }
            Self::Module => {
                "build the lambda with `gleaner build DIR`, which makes a component (wasm32-wasip2)"
            }
        }
    }
}

/// Returns whether the compiler refused a WebAssembly proposal that [`settings`] do not enable.
fn needs_a_proposal(error: &(dyn std::error::Error + 'static)) -> bool {
    let text = chain(error);
    text.contains("must be enabled") || text.contains("not enabled")
}

impl Explain for CompileError {
    fn help(&self) -> Option<String> {
        match self {
            Self::NoComponent { why, .. } => Some(why.help().to_owned()),
            Self::Compile { source, .. } if needs_a_proposal(source.as_ref()) => Some(
                "build it without that WebAssembly proposal: leave out flags such as \
                 `-C target-feature`, as `gleaner build DIR` does"
                    .to_owned(),
            ),
            Self::Compile { .. } => Some(
                "the file may be truncated or damaged; build the lambda again: gleaner build DIR"
                    .to_owned(),
            ),
            Self::Read { .. } => Some("build the lambda again: gleaner build DIR".to_owned()),
            Self::TooLarge { .. } | Self::CodeTooLarge { .. } => Some(
                "remove code that the lambda does not need, or move data to model files".to_owned(),
            ),
            Self::Store(error) => error.help(),
            Self::Engine { .. } => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Read { .. }
            | Self::TooLarge { .. }
            | Self::CodeTooLarge { .. }
            | Self::NoComponent { .. }
            | Self::Compile { .. } => Exit::Usage,
            Self::Store(error) => error.exit(),
            Self::Engine { .. } => Exit::Internal,
        }
    }
}

/// Returns the engine that compiles and runs all lambdas, with a stack of `stack_bytes`, at most
/// [`GUEST_STACK_BYTES`]. Native code depends on `nans`, but not on the stack.
///
/// # Errors
///
/// [`CompileError::Engine`] if this machine does not support it.
pub fn engine(stack_bytes: usize, nans: Nans) -> Result<Engine, CompileError> {
    let mut settings = settings(nans);
    settings.max_wasm_stack(stack_bytes.min(GUEST_STACK_BYTES));
    Engine::new(&settings).map_err(|source| CompileError::Engine { source: source.into() })
}

/// Returns the settings of [`engine`], which [`Nans::settings`] names. Benches change some of them
/// to measure their cost.
pub fn settings(nans: Nans) -> Config {
    let mut config = Config::new();
    config
        // Fuel and interrupts are always compiled in: replay and vehicle use the same code.
        .consume_fuel(true)
        .epoch_interruption(true)
        // A call into a guest costs 0.15 µs without it and 2.7 µs with it.
        .concurrency_support(false)
        // Not deterministic between CPUs.
        .wasm_relaxed_simd(false)
        .max_wasm_stack(GUEST_STACK_BYTES);
    #[cfg(feature = "compiler")]
    config
        .cranelift_opt_level(wasmtime::OptLevel::Speed)
        .cranelift_nan_canonicalization(nans == Nans::Canonical);
    #[cfg(not(feature = "compiler"))]
    let _ = nans;
    config
}

/// Reads a component that is small enough to be compiled.
///
/// # Errors
///
/// [`CompileError::Read`], [`CompileError::TooLarge`].
pub fn read_component(path: &Path) -> Result<Vec<u8>, CompileError> {
    PlainFile::named(path, COMPONENT_MAX).and_then(PlainFile::read_whole).map_err(|source| {
        match NotPlain::of(&source) {
            Some(NotPlain::TooLong { bytes, .. }) => {
                CompileError::TooLarge { path: path.to_owned(), bytes: *bytes }
            }
            _ => CompileError::Read { path: path.to_owned(), source },
        }
    })
}

/// Returns the entry of the native code of `component`, compiled with `nans`, in the folder
/// `store`.
pub fn code_entry(store: &Path, component: &[u8], nans: Nans) -> DerivedEntry {
    let key = DerivedKey::of(DerivedKind::NativeCode, nans.settings(), component);
    DerivedEntry::of(store, key)
}

#[cfg(feature = "compiler")]
mod compiler;
#[cfg(feature = "compiler")]
pub use compiler::compile;
#[cfg(feature = "compiler")]
mod speed;
#[cfg(feature = "compiler")]
pub use speed::fuel_per_second;

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use super::*;

    #[test]
    fn the_settings_name_the_pinned_version() {
        let workspace = include_str!("../../../Cargo.toml");
        for nans in [Nans::Native, Nans::Canonical] {
            assert!(nans.settings().starts_with("wasmtime 48.0.8,"));
        }
        assert!(workspace.contains("wasmtime = { version = \"=48.0.8\""));
    }

    #[test]
    fn another_component_or_other_nans_have_another_entry() {
        let entry =
            |component: &[u8], nans| code_entry(Path::new("/s"), component, nans).path().to_owned();
        assert_eq!(entry(b"a", Nans::Native), entry(b"a", Nans::Native));
        assert_ne!(entry(b"a", Nans::Native), entry(b"b", Nans::Native));
        assert_ne!(entry(b"a", Nans::Native), entry(b"a", Nans::Canonical));
    }

    #[test]
    fn only_a_regular_file_of_bounded_size_is_read_as_a_component() {
        let folder =
            std::env::temp_dir().join(format!("gleaner-compile-read-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let (plain, pipe, device, large) = (
            folder.join("plain"),
            folder.join("pipe"),
            folder.join("device"),
            folder.join("large"),
        );
        fs::write(&plain, b"bytes").unwrap();
        assert_eq!(read_component(&plain).unwrap(), b"bytes");
        rustix::fs::mknodat(
            rustix::fs::CWD,
            &pipe,
            rustix::fs::FileType::Fifo,
            rustix::fs::Mode::RUSR,
            0,
        )
        .unwrap();
        std::os::unix::fs::symlink("/dev/zero", &device).unwrap();
        for none in [&pipe, &device, &folder] {
            let error = read_component(none).unwrap_err();
            let why = std::error::Error::source(&error).unwrap().to_string();
            assert!(
                matches!(error, CompileError::Read { .. }) && why == "it is not a regular file",
                "{why}"
            );
        }
        File::create(&large).unwrap().set_len(COMPONENT_MAX.bytes() + 1).unwrap();
        assert!(
            matches!(read_component(&large), Err(CompileError::TooLarge { bytes, .. }) if bytes == COMPONENT_MAX.bytes() + 1)
        );
        fs::remove_dir_all(&folder).unwrap();
    }
}
