//! Sandboxes this process before a lambda's code runs in it, and reports the layers that hold.
//!
//! `gleaner-shim` sets up the first layers and passes their list. A process that becomes a Python
//! interpreter confines its files before that. [`Isolation::close`] drops everything else, once
//! topics, drives and results are open and before the lambda is loaded. This cannot be undone.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use gleaner_base::programs::cache_dir;
use gleaner_base::{Exit, Failure, safe_file};
use gleaner_lambda::manifest::LambdaKind;
use gleaner_protocol::process_stats::{HEARTBEAT_ENV, Heartbeat};
use gleaner_protocol::{Holds, LAYERS_ENV, Layer, SHIM_ENV};
use gleaner_sandbox::priority::leave_real_time;
use gleaner_sandbox::{JailError, Paths, cgroup, files, memory, sandbox_filter, self_test};
use rustix::process::{Signal, getppid, set_parent_process_death_signal};

/// The sandbox state of this process.
pub struct Isolation {
    permissions: SandboxPermissions,
    heartbeat: Heartbeat,
    layers: OnceLock<Result<Vec<Layer>, JailError>>,
    /// Memory of this process when it was sandboxed, in bytes.
    used_at_close: OnceLock<Option<u64>>,
    bounded: OnceLock<Option<Layer>>,
}

/// Upper bound of the memory in bytes that modules of an interpreter's environment may use beside
/// the limit: numpy takes some 50 MB, and more for each of its threads.
const MODULES: u64 = 256 << 20;

/// Files and memory that a lambda's process keeps.
#[derive(Clone, Debug, Default)]
pub struct SandboxPermissions {
    /// Files that it may still open.
    pub paths: Paths,
    /// Memory that this process may still allocate, in bytes, if it is an interpreter; a
    /// component's memory is counted as it grows.
    pub memory: Option<u64>,
    /// Total memory that it may use, in bytes, including its rings and Gleaner's own code.
    pub all: u64,
}

impl Isolation {
    /// The state of this process, which from now on does not outlive its parent: with a shim it is
    /// killed, since only the shim ends a lambda that hangs; otherwise it gets SIGTERM.
    ///
    /// # Errors
    ///
    /// A failure if the page that the shim reads cannot be used, or if the shim has ended already.
    pub fn of_this_process(permissions: SandboxPermissions) -> Result<Self, Failure> {
        let failed = |what: &str, error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, what, error)
        };
        let heartbeat =
            Heartbeat::inherited().map_err(|error| failed("cannot use the shim's page", &error))?;
        let has_shim = std::env::var_os(HEARTBEAT_ENV).is_some();
        die_with_parent(if has_shim { Signal::KILL } else { Signal::TERM })?;
        // The shim has done so. Without it, threads are yet to be started.
        leave_real_time()
            .map_err(|error| failed("cannot give up the priority of real time", &error))?;
        // The signal is sent once, so an earlier end of the shim is checked here.
        let shim = std::env::var(SHIM_ENV).ok().filter(|_| has_shim);
        let parent = getppid().map(|parent| parent.as_raw_nonzero().to_string());
        if shim.is_some() && shim != parent {
            return Err(Failure::new(Exit::Internal, "gleaner-shim has ended")
                .with_help("start the lambda again"));
        }
        Ok(Self {
            permissions,
            heartbeat,
            layers: OnceLock::new(),
            used_at_close: OnceLock::new(),
            bounded: OnceLock::new(),
        })
    }

    /// The page that the shim reads.
    pub fn heartbeat(&self) -> &Heartbeat {
        &self.heartbeat
    }

    /// Limits the memory of an interpreter that has loaded its modules, which count for 256 MiB at
    /// most. Until then, an earlier limit holds. Later calls change nothing.
    ///
    /// # Errors
    ///
    /// The reason why the limit does not hold: the lambda must not run.
    pub fn bound_memory(&self) -> Result<(), String> {
        let layer = self.bounded.get_or_init(|| {
            let before = self.used_at_close.get().copied().flatten();
            let now = memory::used()
                .zip(before)
                .map(|(now, before)| now.min(before.saturating_add(MODULES)));
            self.permissions.memory.map(|more| memory::limit_beyond(now, more))
        });
        match layer {
            Some(Layer { holds: Holds::No, note, .. }) => {
                Err(format!("cannot limit the memory of its process: {note}"))
            }
            _ => Ok(()),
        }
    }

    /// Drops the privileges that the lambda's process no longer needs; returns the layers that were
    /// verified, and those that are missing. Later calls change nothing.
    ///
    /// # Errors
    ///
    /// A failure if this process cannot be sandboxed on a system that supports it: the lambda must
    /// not run.
    pub fn close(&self) -> Result<&[Layer], Failure> {
        let layers = self.layers.get_or_init(|| {
            let SandboxPermissions { paths, memory: allowed, all } = &self.permissions;
            let mut layers = layers_of_starter();
            limit_cgroup(&mut layers, *all);
            if let Some(files) = layers.iter_mut().find(|layer| layer.name == files::NAME) {
                // The process that started the interpreter has confined its reads.
                let writes = files::confine_writes(&paths.write);
                if writes.holds == Holds::No && files.holds != Holds::No {
                    let why = format!("the results can still be changed: {}", writes.note);
                    *files = Layer::partly(files::NAME, why);
                }
            } else if allowed.is_some() {
                // The files that an interpreter reads are known only to the process that starts it.
                layers.push(Layer::no(
                    files::NAME,
                    "this interpreter was not started by gleaner-runtime",
                ));
            } else {
                layers.push(files::confine(paths));
            }
            let bound =
                allowed.map(|more| format!("a data limit of {} MiB above the start", more >> 20));
            let counted = "the component's memories are counted as they grow";
            layers.push(Layer::yes(memory::NAME, bound.as_deref().unwrap_or(counted)));
            let denied = sandbox_filter::apply(allowed.is_some())?;
            layers.retain(|layer| denied.iter().all(|denied| denied.name != layer.name));
            layers.extend(denied);
            self.used_at_close.get_or_init(memory::used);
            Ok(self_test::verify(layers))
        });
        layers.as_deref().map_err(|error| {
            Failure::caused_by(Exit::Denied, "cannot sandbox the lambda's process", error)
                .with_help(
                    "check which code the .pth files of its .venv start; or create the .venv again",
                )
        })
    }
}

/// Requests `signal` for this process when its parent dies.
pub fn die_with_parent(signal: Signal) -> Result<(), Failure> {
    set_parent_process_death_signal(Some(signal)).map_err(|error| {
        let error = std::io::Error::from(error);
        Failure::caused_by(Exit::Internal, "cannot make this process end with its parent", &error)
    })
}

/// The layers that `gleaner-shim`, or the process that became this interpreter, has set up.
fn layers_of_starter() -> Vec<Layer> {
    let layers = std::env::var(LAYERS_ENV).ok().and_then(|text| serde_json::from_str(&text).ok());
    layers.unwrap_or_else(|| {
        vec![Layer::no("hard deadline", "started without gleaner-shim: a hang is not ended")]
    })
}

/// Confines the files of this process, and of the interpreter `program` that it is about to become,
/// and limits its memory; returns the value of [`LAYERS_ENV`] for the interpreter.
pub fn before_interpreter(permissions: SandboxPermissions, program: &Path) -> String {
    let SandboxPermissions { mut paths, memory: allowed, all } = permissions;
    paths.interpreter(program);
    let mut layers = layers_of_starter();
    limit_cgroup(&mut layers, all);
    layers.push(files::confine(&paths));
    let bounded = allowed.map(memory::limit).filter(|layer| layer.holds == Holds::No);
    // Without a shim, the process itself creates the page that the shim would read.
    let has_page = std::env::var_os(HEARTBEAT_ENV).is_some();
    let start = sandbox_filter::apply_before_interpreter(has_page);
    layers.push(bounded.map_or(start, |layer| Layer::no(sandbox_filter::START, layer.note)));
    serde_json::to_string(&layers).expect("layers are plain data")
}

/// Limits the control group of this process, if it has one, to `all` bytes of memory.
fn limit_cgroup(layers: &mut Vec<Layer>, all: u64) {
    if let Some(layer) = cgroup::limit_memory(all) {
        layers.retain(|layer| layer.name != cgroup::NAME);
        layers.push(layer);
    }
}

/// Folders that are searched for message definitions. Every process may read them.
pub fn definition_dirs() -> Vec<PathBuf> {
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    std::env::split_paths(&prefixes)
        .filter(|path| path.is_absolute() && path.parent().is_some())
        .collect()
}

/// The folder of compiled code, for a lambda of a kind that is compiled. Other lambdas share it.
pub fn code_cache_dir(kind: LambdaKind) -> Option<PathBuf> {
    match kind {
        LambdaKind::Wasm => cache_dir().ok(),
        LambdaKind::Python => None,
    }
}

/// Creates the folder of the results and returns its real path. A link in `folder` must not lead
/// out of the lambda's folder.
///
/// # Errors
///
/// A failure that names the link, or the reason why the folder cannot be created.
pub fn create_results_dir(folder: &Path, lambda: &Path) -> Result<PathBuf, Failure> {
    let failed = |error: &dyn std::error::Error| {
        Failure::caused_by(
            Exit::Internal,
            format!("cannot create folder `{}`", folder.display()),
            error,
        )
        .with_help("choose another folder: --out DIR")
    };
    safe_file::refuse_linked(folder, lambda)?;
    std::fs::create_dir_all(folder).map_err(|error| failed(&error))?;
    folder.canonicalize().map_err(|error| failed(&error))
}
