//! The engine that all lambdas run on, and the cache of their native code.
//!
//! Compiling takes a second and 40 MB, loading 0.3 ms and 11 MB; so a component is compiled once, in a process of its own
//! (`gleaner-compile`), and every runtime loads what that left. Loading native code means trusting it: entries are bound to
//! the component's digest, to wasmtime's version, to the settings below and to the CPU, and must belong to this user alone.
//! A component is hostile until proven otherwise, so compiling has a limit of memory and of time.

use std::fs::{self, File, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use gleaner_protocol::layout::COMPONENT_MAX;
use gleaner_protocol::{Exit, Explain, NotPlain, PlainFile, hex};
use sha2::{Digest, Sha256};
use wasmtime::{Config, Engine};

/// Largest native code that is kept, in bytes.
pub const CODE_BYTES: usize = 256 << 20;

/// Memory that compiling may take, in bytes; an ordinary lambda takes some 50 MB. A small component can be made to take any.
pub const COMPILE_MEMORY_BYTES: u64 = 2 << 30;

/// Seconds of CPU time that compiling may take; an ordinary lambda takes one.
pub const COMPILE_CPU_SECONDS: u64 = 120;

/// Most stack of a guest, in bytes. The thread that runs it needs some more.
pub const GUEST_STACK_BYTES: usize = 512 << 10;

/// Which bits a NaN has that a component computes.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub enum Nans {
    /// Those that the CPU gives it, as WebAssembly allows. Only who looks at the bits can tell.
    #[default]
    AsMade,
    /// The same on every CPU. On spectra this costs twice the time and more, see `bench/README.md`.
    Canonical,
}

impl Nans {
    /// Wasmtime's version and the settings of [`engine`]; a change of either makes new entries.
    pub const fn settings(self) -> &'static str {
        match self {
            Self::AsMade => "wasmtime 48.0.8, fuel, epochs, speed, 1",
            Self::Canonical => "wasmtime 48.0.8, fuel, epochs, speed, canonical NaNs, 1",
        }
    }
}

/// Why native code could not be made or found.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum CompileError {
    #[error("cannot read component `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("component `{}` has {bytes} bytes; at most {COMPONENT_MAX} are compiled", path.display())]
    TooLarge { path: PathBuf, bytes: u64 },
    #[error("cannot compile component `{}`", path.display())]
    Compile { path: PathBuf, source: Box<dyn std::error::Error + Send + Sync> },
    #[error("component `{}` becomes {bytes} bytes of native code; at most {CODE_BYTES} are kept", path.display())]
    CodeTooLarge { path: PathBuf, bytes: usize },
    #[error("cannot set up the engine")]
    Engine { source: Box<dyn std::error::Error + Send + Sync> },
    #[error("cannot write native code to `{}`", path.display())]
    Write { path: PathBuf, source: io::Error },
    #[error("native code in `{}` is not loaded: {why}", path.display())]
    Untrusted { path: PathBuf, why: &'static str },
}

impl Explain for CompileError {
    fn help(&self) -> Option<String> {
        match self {
            Self::Read { .. } | Self::Compile { .. } => Some("build the lambda again: gleaner build DIR".to_owned()),
            Self::TooLarge { .. } | Self::CodeTooLarge { .. } => {
                Some("leave out what the lambda does not need, or move data to files of a model".to_owned())
            }
            Self::Write { .. } => Some("make the folder writable, or set XDG_CACHE_HOME to one that is".to_owned()),
            Self::Untrusted { path, .. } => {
                Some(format!("delete it, it will be made again: rm -r '{}'", path.display()))
            }
            Self::Engine { .. } => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Read { .. } | Self::TooLarge { .. } | Self::CodeTooLarge { .. } | Self::Compile { .. } => Exit::Usage,
            Self::Untrusted { .. } => Exit::Denied,
            Self::Write { .. } | Self::Engine { .. } => Exit::Internal,
        }
    }
}

/// The engine for which all lambdas are compiled and on which they run, with a stack of so many bytes, at most
/// [`GUEST_STACK_BYTES`]. Native code does not depend on that, but on `nans`.
///
/// # Errors
///
/// [`CompileError::Engine`] if this machine does not support it.
pub fn engine(stack_bytes: usize, nans: Nans) -> Result<Engine, CompileError> {
    let mut settings = settings(nans);
    settings.max_wasm_stack(stack_bytes.min(GUEST_STACK_BYTES));
    Engine::new(&settings).map_err(|source| CompileError::Engine { source: source.into() })
}

/// What [`engine`] is set to, named by [`Nans::settings`]; benches change a part of it to tell its price.
pub fn settings(nans: Nans) -> Config {
    let mut config = Config::new();
    config
        // Instructions are counted and the clock can interrupt, always: the same code serves replay and vehicle.
        .consume_fuel(true)
        .epoch_interruption(true)
        // A call into a guest costs 0.15 µs without it and 2.7 µs with it.
        .concurrency_support(false)
        // Not deterministic between CPUs.
        .wasm_relaxed_simd(false)
        .max_wasm_stack(GUEST_STACK_BYTES);
    #[cfg(feature = "compiler")]
    config.cranelift_opt_level(wasmtime::OptLevel::Speed).cranelift_nan_canonicalization(nans == Nans::Canonical);
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
            Some(NotPlain::TooLong { bytes, .. }) => CompileError::TooLarge { path: path.to_owned(), bytes: *bytes },
            _ => CompileError::Read { path: path.to_owned(), source },
        }
    })
}

/// Where the native code of `component` is kept on this machine: `<cache>/<key>.cwasm`.
pub fn cache_entry(cache: &Path, component: &[u8], nans: Nans) -> PathBuf {
    let mut key = Sha256::new();
    for part in [nans.settings().as_bytes(), std::env::consts::ARCH.as_bytes(), cpu_features().as_bytes(), component] {
        key.update((part.len() as u64).to_le_bytes());
        key.update(part);
    }
    cache.join(hex(&key.finalize()) + ".cwasm")
}

/// What this machine's CPU can do, as the kernel says: a cache in a home folder may be shared by several machines.
/// Wasmtime checks the same again when it loads code, and refuses what does not fit.
fn cpu_features() -> String {
    let cpus = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let features = cpus.lines().find(|line| line.starts_with("flags") || line.starts_with("Features"));
    features.unwrap_or_default().to_owned()
}

/// Opens `entry` for loading, if nobody else could have written it: it and the folders above it belong to this user or to
/// root, and nobody else may write to them. What is checked is what was opened.
///
/// # Errors
///
/// [`CompileError::Untrusted`] says what is wrong; [`CompileError::Read`] if there is no entry.
pub fn open_entry(entry: &Path) -> Result<File, CompileError> {
    check_folder(entry.parent().unwrap_or(entry))?;
    let read = |source| CompileError::Read { path: entry.to_owned(), source };
    let file = OpenOptions::new().read(true).custom_flags(NO_FOLLOW).open(entry).map_err(read)?;
    let meta = file.metadata().map_err(read)?;
    let wrong = if meta.is_file() { foreign(&meta) } else { Some("it is no file") };
    match wrong {
        Some(why) => Err(CompileError::Untrusted { path: entry.to_owned(), why }),
        None => Ok(file),
    }
}

/// Checks that only this user can put files into `folder`, or replace it.
///
/// # Errors
///
/// As [`open_entry`].
pub fn check_folder(folder: &Path) -> Result<(), CompileError> {
    let read = |source| CompileError::Read { path: folder.to_owned(), source };
    let untrusted = |path: &Path, why| Err(CompileError::Untrusted { path: path.to_owned(), why });
    let whole = fs::canonicalize(folder).map_err(read)?;
    for (above, path) in whole.ancestors().enumerate() {
        let meta = fs::symlink_metadata(path).map_err(read)?;
        let root_owns = meta.uid() == 0;
        let wrong = match foreign(&meta) {
            // Folders above may be root's; in one that all may write to, like /tmp, the sticky bit protects what is ours.
            Some(NOT_OURS) if above > 0 && root_owns && meta.mode() & 0o022 == 0 => None,
            Some(_) if above > 0 && root_owns && meta.mode() & 0o1000 != 0 => None,
            wrong => wrong,
        };
        if let Some(why) = wrong {
            return untrusted(path, why);
        }
    }
    Ok(())
}

const NOT_OURS: &str = "it belongs to another user";
/// `O_NOFOLLOW`.
const NO_FOLLOW: i32 = rustix::fs::OFlags::NOFOLLOW.bits() as i32;

fn foreign(meta: &Metadata) -> Option<&'static str> {
    if meta.uid() != rustix::process::geteuid().as_raw() {
        Some(NOT_OURS)
    } else if meta.mode() & 0o022 != 0 {
        Some("others may write to it")
    } else {
        None
    }
}

/// Makes the cache folder, for this user alone.
///
/// # Errors
///
/// [`CompileError::Write`].
pub fn make_cache(cache: &Path) -> Result<(), CompileError> {
    let write = |source| CompileError::Write { path: cache.to_owned(), source };
    if let Some(parent) = cache.parent() {
        fs::create_dir_all(parent).map_err(write)?;
    }
    match fs::DirBuilder::new().mode(0o700).create(cache) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(write(error)),
        _ => Ok(()),
    }
}

#[cfg(feature = "compiler")]
mod compiler;
#[cfg(feature = "compiler")]
pub use compiler::compile;
#[cfg_attr(not(feature = "compiler"), allow(dead_code, reason = "who compiles cleans up"))]
mod prune;
pub use prune::{CACHE_BYTES, note_use};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_component_has_another_entry() {
        let entry = |bytes: &[u8]| cache_entry(Path::new("/c"), bytes, Nans::AsMade);
        assert_eq!(entry(b"a"), entry(b"a"));
        assert_ne!(entry(b"a"), entry(b"b"));
        assert_ne!(entry(b"a"), cache_entry(Path::new("/c"), b"a", Nans::Canonical));
        assert_eq!(entry(b"a").file_name().unwrap().len(), 64 + ".cwasm".len());
    }

    #[test]
    fn the_settings_name_the_version_that_is_pinned() {
        let workspace = include_str!("../../../Cargo.toml");
        for nans in [Nans::AsMade, Nans::Canonical] {
            assert!(nans.settings().starts_with("wasmtime 48.0.8,"));
        }
        assert!(workspace.contains("wasmtime = { version = \"=48.0.8\""));
    }

    #[test]
    fn only_a_file_of_a_bounded_size_is_read_as_a_component() {
        let folder = std::env::temp_dir().join(format!("gleaner-compile-read-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let (plain, pipe, device, large) =
            (folder.join("plain"), folder.join("pipe"), folder.join("device"), folder.join("large"));
        fs::write(&plain, b"bytes").unwrap();
        assert_eq!(read_component(&plain).unwrap(), b"bytes");
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, rustix::fs::Mode::RUSR, 0).unwrap();
        std::os::unix::fs::symlink("/dev/zero", &device).unwrap();
        for none in [&pipe, &device, &folder] {
            let error = read_component(none).unwrap_err();
            let why = std::error::Error::source(&error).unwrap().to_string();
            assert!(matches!(error, CompileError::Read { .. }) && why == "it is no file", "{why}");
        }
        File::create(&large).unwrap().set_len(COMPONENT_MAX.bytes() + 1).unwrap();
        assert!(
            matches!(read_component(&large), Err(CompileError::TooLarge { bytes, .. }) if bytes == COMPONENT_MAX.bytes() + 1)
        );
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn code_that_others_may_write_is_not_trusted() {
        use std::os::unix::fs::PermissionsExt;
        let cache = std::env::temp_dir().join(format!("gleaner-compile-test-{}", std::process::id()));
        make_cache(&cache).unwrap();
        let entry = cache.join("x.cwasm");
        fs::write(&entry, b"code").unwrap();
        fs::set_permissions(&entry, fs::Permissions::from_mode(0o600)).unwrap();
        open_entry(&entry).unwrap();
        let refused = |path: &Path, mode| {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
            open_entry(&entry).unwrap_err().to_string()
        };
        let said = refused(&entry, 0o620);
        assert!(said.contains("x.cwasm` is not loaded: others may write to it"), "{said}");
        let said = refused(&cache, 0o770);
        assert!(said.ends_with("others may write to it") && !said.contains("x.cwasm"), "{said}");
        fs::set_permissions(&cache, fs::Permissions::from_mode(0o700)).unwrap();
        let link = cache.join("link.cwasm");
        std::os::unix::fs::symlink(&entry, &link).unwrap();
        assert!(matches!(open_entry(&link), Err(CompileError::Read { .. })));
        fs::remove_dir_all(&cache).unwrap();
    }
}
