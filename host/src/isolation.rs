//! What this process may do once foreign code is in it, and what is told of that.
//!
//! `gleaner-shim` has set up the first layers and told us of them. A process that becomes a Python
//! interpreter confines its files before; everything else is given up by [`Isolation::close`], when
//! topics, drives and results are open and the lambda is not in yet. From there on no way leads
//! back.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use gleaner_base::{Exit, Failure, own_file};
use gleaner_jail::{JailError, Paths, alone, cgroup, files, memory, tried};
use gleaner_lambda::manifest::Kind;
use gleaner_parts::cache_dir;
use gleaner_protocol::{Holds, LAYERS_ENV, Layer};
use gleaner_vitals::{PULSE_ENV, Pulse};
use rustix::process::{Signal, set_parent_process_death_signal};

/// How far this process is shut.
pub struct Isolation {
    inside: Inside,
    pulse: Pulse,
    layers: OnceLock<Result<Vec<Layer>, JailError>>,
    /// Memory that this process had when it was shut.
    taken: OnceLock<Option<u64>>,
    bounded: OnceLock<Option<Layer>>,
}

/// Most memory that modules of an interpreter's environment add to what it may have, in bytes:
/// numpy takes some 50 MB, and more for each of its threads.
const MODULES: u64 = 256 << 20;

/// What is left to a lambda's process.
#[derive(Clone, Debug, Default)]
pub struct Inside {
    /// Files that it may still open.
    pub paths: Paths,
    /// Memory that this process may still take, in bytes, if it is an interpreter; that of a
    /// component is counted as it grows.
    pub memory: Option<u64>,
    /// Memory that it may take in all, its rings and our own part included, in bytes.
    pub all: u64,
}

impl Isolation {
    /// That of this process, which from now on does not outlive whoever started it: a shim takes it
    /// along, since nobody else would end a lambda that hangs; anybody else has it end in order.
    ///
    /// # Errors
    ///
    /// If the page that the shim looks at cannot be used.
    pub fn of_this_process(inside: Inside) -> Result<Self, Failure> {
        let failed = |what: &str, error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, what, error)
        };
        let pulse =
            Pulse::inherited().map_err(|error| failed("cannot use the shim's page", &error))?;
        let has_shim = std::env::var_os(PULSE_ENV).is_some();
        end_with_starter(if has_shim { Signal::KILL } else { Signal::TERM })?;
        Ok(Self {
            inside,
            pulse,
            layers: OnceLock::new(),
            taken: OnceLock::new(),
            bounded: OnceLock::new(),
        })
    }

    /// The page that the shim looks at.
    pub fn pulse(&self) -> &Pulse {
        &self.pulse
    }

    /// Bounds the memory of an interpreter, which has its modules by now: they count for 256 MiB at
    /// most. An earlier bound holds until then. Once.
    ///
    /// # Errors
    ///
    /// What keeps that from holding: the lambda must not be let in.
    pub fn bound_memory(&self) -> Result<(), String> {
        let layer = self.bounded.get_or_init(|| {
            let before = self.taken.get().copied().flatten();
            let now = memory::taken()
                .zip(before)
                .map(|(now, before)| now.min(before.saturating_add(MODULES)));
            self.inside.memory.map(|more| memory::limit_beyond(now, more))
        });
        match layer {
            Some(Layer { holds: Holds::No, note, .. }) => {
                Err(format!("cannot bound the memory of its process: {note}"))
            }
            _ => Ok(()),
        }
    }

    /// Gives up what the lambda's process does not need any more; gives the layers that were seen
    /// to hold, and those that are not there. Later calls change nothing.
    ///
    /// # Errors
    ///
    /// A failure if something in this process cannot be shut in, though the system could do it: the
    /// lambda must not be let in.
    pub fn close(&self) -> Result<&[Layer], Failure> {
        let layers = self.layers.get_or_init(|| {
            let Inside { paths, memory: allowed, all } = &self.inside;
            let mut layers = told_by_starter();
            fit(&mut layers, *all);
            if layers.iter().any(|layer| layer.name == files::NAME) {
                // Reading is confined already, by who knew what the interpreter reads.
                let writes = files::confine_writes(&paths.write);
                if let Some(layer) = writes {
                    layers.retain(|layer| layer.name != files::NAME);
                    layers.push(layer);
                }
            } else if allowed.is_some() {
                // What it reads only whoever starts it can know.
                layers.push(Layer::no(
                    files::NAME,
                    "this interpreter was not started by gleaner-runtime",
                ));
            } else {
                layers.push(files::confine(paths));
            }
            let bound = allowed
                .map(|more| format!("a limit of data: {} MiB more than at the start", more >> 20));
            let counted = "the component's memories are counted as they grow";
            layers.push(Layer::yes(memory::NAME, bound.as_deref().unwrap_or(counted)));
            layers.extend(alone::stay(allowed.is_some())?);
            self.taken.get_or_init(memory::taken);
            Ok(tried::tried(layers))
        });
        layers.as_deref().map_err(|error| {
            Failure::caused_by(Exit::Denied, "cannot shut in the lambda's process", error).with_help(
                "look for what its environment starts by itself, in the .pth files of its .venv; or make that anew",
            )
        })
    }
}

/// Has this process end by `signal` when the process that started it dies.
///
/// # Errors
///
/// A failure if the system refuses that.
pub fn end_with_starter(signal: Signal) -> Result<(), Failure> {
    set_parent_process_death_signal(Some(signal)).map_err(|error| {
        let error = std::io::Error::from(error);
        Failure::caused_by(
            Exit::Internal,
            "cannot have this process end with the one that started it",
            &error,
        )
    })
}

/// The layers that `gleaner-shim`, or the process that became this interpreter, has set up.
fn told_by_starter() -> Vec<Layer> {
    let told = std::env::var(LAYERS_ENV).ok().and_then(|text| serde_json::from_str(&text).ok());
    told.unwrap_or_else(|| {
        vec![Layer::no("hard deadline", "started without gleaner-shim: nobody ends what hangs")]
    })
}

/// Confines the files of this process, and of the interpreter `program` that it is about to become,
/// and bounds its memory; gives the value of [`LAYERS_ENV`] for that.
pub fn before_interpreter(inside: Inside, program: &Path) -> String {
    let Inside { mut paths, memory: allowed, all } = inside;
    paths.interpreter(program);
    let mut layers = told_by_starter();
    fit(&mut layers, all);
    layers.push(files::confine(&paths));
    let bounded = allowed.map(memory::limit).filter(|layer| layer.holds == Holds::No);
    // Without a shim the process makes the page itself that the shim would read.
    let has_page = std::env::var_os(PULSE_ENV).is_some();
    let start = alone::before_interpreter(has_page);
    layers.push(bounded.map_or(start, |layer| Layer::no(alone::START, layer.note)));
    serde_json::to_string(&layers).expect("layers are plain data")
}

/// Has the control group of this process, if it has one, allow no more than `all` bytes of memory.
fn fit(layers: &mut Vec<Layer>, all: u64) {
    if let Some(layer) = cgroup::fit(all) {
        layers.retain(|layer| layer.name != cgroup::NAME);
        layers.push(layer);
    }
}

/// Where definitions of messages are looked for: everybody may read them.
pub fn definitions() -> Vec<PathBuf> {
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    std::env::split_paths(&prefixes)
        .filter(|path| path.is_absolute() && path.parent().is_some())
        .collect()
}

/// Where compiled code lies, for a lambda of a kind that is compiled: code of others may lie there,
/// too.
pub fn code(kind: Kind) -> Option<PathBuf> {
    match kind {
        Kind::Wasm => cache_dir().ok(),
        Kind::Python => None,
    }
}

/// Makes sure that results are where they seem to be: `folder` is made now, and is no way out of
/// the lambda's folder.
///
/// # Errors
///
/// A failure that names the link, or why the folder cannot be made.
pub fn place_of_results(folder: &Path, lambda: &Path) -> Result<PathBuf, Failure> {
    let failed = |error: &dyn std::error::Error| {
        Failure::caused_by(Exit::Internal, format!("cannot make `{}`", folder.display()), error)
            .with_help("choose another folder: --out DIR")
    };
    own_file::real_place(folder, lambda)?;
    std::fs::create_dir_all(folder).map_err(|error| failed(&error))?;
    folder.canonicalize().map_err(|error| failed(&error))
}
