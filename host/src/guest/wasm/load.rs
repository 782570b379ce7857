//! Loads a component: takes its native code from the store, or has `gleaner-compile` compile it
//! there.
#![allow(unsafe_code)]

use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_artifacts::{DerivedEntry, StoreLookup, make_store};
use gleaner_base::programs::{InstallationError, InstalledPrograms};
use gleaner_base::{Exit, Explain, Failure};
use gleaner_compile::{
    COMPILE_CPU_SECONDS, COMPILE_MEMORY_BYTES, CompileError, Nans, code_entry, read_component,
};
use sha2::{Digest, Sha256};
use wasmtime::component::{Component, Linker};
use wasmtime::{Engine, Store};

use super::Hosted;
use super::bindings::{Lambda, LambdaPre};
use super::data::add_reads_to_linker;
use super::wasi;

#[derive(Debug, thiserror::Error)]
pub enum WasmError {
    #[error(transparent)]
    Compile(#[from] CompileError),
    #[error(transparent)]
    InstalledPrograms(#[from] InstallationError),
    #[error("cannot start `{}`", program.display())]
    Start { program: PathBuf, source: std::io::Error },
    #[error("{message}")]
    Compiler {
        message: String,
        source: Option<Box<CompilerMessage>>,
        help: Option<String>,
        exit: Exit,
    },
    #[error("cannot compile component `{}`", path.display())]
    Limit { path: PathBuf, source: CompilerMessage },
    #[error("cannot load native code `{}`", path.display())]
    Load { path: PathBuf, source: Box<dyn std::error::Error + Send + Sync> },
    #[error("component `{}` does not fit the world `gleaner:lambda/lambda`", path.display())]
    World { path: PathBuf, source: Box<dyn std::error::Error + Send + Sync> },
}

/// A cause that `gleaner-compile` printed when it failed, or the limit that ended it.
#[derive(Debug, thiserror::Error)]
#[error("{text}")]
pub struct CompilerMessage {
    text: String,
    source: Option<Box<CompilerMessage>>,
}

impl Explain for WasmError {
    fn help(&self) -> Option<String> {
        match self {
            Self::Compile(error) => error.help(),
            Self::InstalledPrograms(error) => error.help(),
            Self::World { .. } => Some(
                "build it against this version's SDK: implement `Lambda` and export it with \
                 `gleaner_sdk::lambda!`; \
                 a component may import `gleaner:lambda` and WASI 0.2, nothing else"
                    .to_owned(),
            ),
            Self::Compiler { help, .. } => help.clone(),
            Self::Limit { .. } => Some(
                "remove code that the lambda does not need, or move data to files of a model"
                    .to_owned(),
            ),
            Self::Load { path, .. } => Some(format!(
                "start again; if that does not help, delete the file, which will be created again: \
                 rm '{}'",
                path.display()
            )),
            Self::Start { .. } => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Compile(error) => error.exit(),
            Self::InstalledPrograms(error) => error.exit(),
            Self::Compiler { exit, .. } => *exit,
            Self::Limit { .. } | Self::World { .. } => Exit::Usage,
            Self::Start { .. } | Self::Load { .. } => Exit::Internal,
        }
    }
}

/// A component that was checked against the world and is ready to be instantiated.
#[derive(Clone)]
pub struct Loaded {
    engine: Engine,
    lambda: LambdaPre<Hosted>,
    seed: [u8; 32],
    nans: Nans,
    counts_fuel: bool,
}

impl Loaded {
    /// Loads the component at `path`, and compiles it into `cache` first if necessary. It gets a
    /// stack of `stack_bytes`, and NaNs of this kind.
    pub fn open(
        path: &Path,
        cache: &Path,
        stack_bytes: usize,
        nans: Nans,
    ) -> Result<Self, WasmError> {
        let component = read_component(path)?;
        let engine = gleaner_compile::engine(stack_bytes, nans)?;
        let entry = code_entry(cache, &component, nans);
        let code = native_code(&entry, path, cache, nans)?;
        // SAFETY: these bytes are in this process's memory. `DerivedEntry::read` found that their
        // digest is the one that `gleaner-compile` wrote for this component, engine and CPU, in a
        // file and below folders to which only this user or root may write.
        let code = unsafe { Component::deserialize(&engine, &code) }.map_err(|source| {
            WasmError::Load { path: entry.path().to_owned(), source: source.into() }
        })?;
        let lambda = Self::check(path, &engine, &code)?;
        let seed = Sha256::digest(&component).into();
        Ok(Self { engine, lambda, seed, nans, counts_fuel: true })
    }

    /// Takes the component at `path`, which a bench has compiled as `code` with other checks than
    /// [`gleaner_compile::settings`] has, to measure their cost. Without fuel, nothing but a
    /// deadline ends its code.
    pub fn with_checks(
        path: &Path,
        code: &Component,
        counts_fuel: bool,
    ) -> Result<Self, WasmError> {
        let component = read_component(path)?;
        let engine = code.engine().clone();
        let lambda = Self::check(path, &engine, code)?;
        let seed = Sha256::digest(&component).into();
        Ok(Self { engine, lambda, seed, nans: Nans::Native, counts_fuel })
    }

    fn check(
        path: &Path,
        engine: &Engine,
        code: &Component,
    ) -> Result<LambdaPre<Hosted>, WasmError> {
        let world = |source: wasmtime::Error| WasmError::World {
            path: path.to_owned(),
            source: source.into(),
        };
        let mut linker = Linker::new(engine);
        wasi::add_to_linker(&mut linker).map_err(world)?;
        Lambda::add_to_linker::<_, wasmtime::component::HasSelf<_>>(&mut linker, |hosted| hosted)
            .map_err(world)?;
        add_reads_to_linker(&mut linker).map_err(world)?;
        linker.instantiate_pre(code).and_then(LambdaPre::new).map_err(world)
    }

    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// Wasmtime's version, and the settings of the compiler.
    pub(super) fn settings(&self) -> &'static str {
        self.nans.settings()
    }

    /// Returns whether its engine counts fuel: always, except in a bench.
    pub(super) fn counts_fuel(&self) -> bool {
        self.counts_fuel
    }

    pub(super) fn seed(&self) -> [u8; 32] {
        self.seed
    }

    pub(super) fn instantiate(&self, store: &mut Store<Hosted>) -> wasmtime::Result<Lambda> {
        self.lambda.instantiate(store)
    }
}

/// Returns the code in `entry`, and compiles it first if it is missing or damaged.
fn native_code(
    entry: &DerivedEntry,
    path: &Path,
    cache: &Path,
    nans: Nans,
) -> Result<Vec<u8>, WasmError> {
    make_store(cache).map_err(CompileError::from)?;
    match entry.read().map_err(CompileError::from)? {
        StoreLookup::Content(code) => return Ok(code),
        StoreLookup::Nothing => {}
        StoreLookup::Damaged(why) => {
            let file = entry.path().display();
            tracing::warn!(
                %file,
                %why,
                "native code in the cache is damaged; compiling the component again"
            );
        }
    }
    compile(path, cache, nans)?;
    let why = match entry.read().map_err(CompileError::from)? {
        StoreLookup::Content(code) => return Ok(code),
        StoreLookup::Nothing => {
            "the code is missing: the component or the cache was changed meanwhile".to_owned()
        }
        StoreLookup::Damaged(why) => format!("the code was just written, and {why}"),
    };
    Err(WasmError::Load { path: entry.path().to_owned(), source: why.into() })
}

/// Maximum number of compiler threads. Each needs address space, which is limited, and a lambda's
/// code compiles quickly.
const COMPILE_THREADS: usize = 8;

fn compile(path: &Path, cache: &Path, nans: Nans) -> Result<(), WasmError> {
    let program = InstalledPrograms::find()?.program("gleaner-compile")?;
    let threads =
        std::thread::available_parallelism().map_or(1, |cores| cores.get().min(COMPILE_THREADS));
    let output = Command::new(&program)
        .arg(path)
        .arg("--cache")
        .arg(cache)
        .args((nans == Nans::Canonical).then_some("--deterministic"))
        .env("RAYON_NUM_THREADS", threads.to_string())
        // Otherwise the allocator reserves address space for each of them.
        .env("MALLOC_ARENA_MAX", "2")
        .output()
        .map_err(|source| WasmError::Start { program, source })?;
    if output.status.success() {
        return Ok(());
    }
    if let Some(signal) = output.status.signal() {
        // Ended by a signal: it ran into its limits.
        let memory = COMPILE_MEMORY_BYTES >> 20;
        let text = match signal {
            libc::SIGXCPU => {
                format!("compiling takes more than {COMPILE_CPU_SECONDS} s of CPU time")
            }
            libc::SIGABRT => format!("compiling takes more than {memory} MiB of memory"),
            _ => format!(
                "compiling takes more than {memory} MiB of memory or {COMPILE_CPU_SECONDS} s"
            ),
        };
        return Err(WasmError::Limit {
            path: path.to_owned(),
            source: CompilerMessage { text, source: None },
        });
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    let exit = output.status.code().and_then(Exit::from_code).unwrap_or(Exit::Internal);
    let Failure { exit, message, causes, help } = Failure::parse(&stderr, exit)
        .unwrap_or_else(|| Failure::new(exit, format!("gleaner-compile: {}", stderr.trim())));
    let chain = |source, text| Some(Box::new(CompilerMessage { text, source }));
    Err(WasmError::Compiler {
        message,
        source: causes.into_iter().rev().fold(None, chain),
        help,
        exit,
    })
}
