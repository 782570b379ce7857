use std::io;
use std::path::PathBuf;

use gleaner_base::{Exit, Explain, NotPlain};

/// A place or program that was tried, and why it would not do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Looked {
    /// What was tried.
    pub at: PathBuf,
    /// Why it would not do.
    pub why: String,
}

/// Why a part of the installation is not found.
#[derive(Debug, thiserror::Error)]
pub enum PartsError {
    /// The system does not say where the running program lies.
    #[error("cannot find out where this program lies")]
    NoExecutable {
        /// Why not.
        source: io::Error,
    },
    /// The folder that the user wants is no installation.
    #[error("GLEANER_HOME is `{}`, where nothing of Gleaner lies", home.display())]
    Home {
        /// The folder.
        home: PathBuf,
    },
    /// The interpreter that the user wants will not do.
    #[error("GLEANER_PYTHON is `{}`, which cannot be used: {}", wanted.at.display(), wanted.why)]
    WantedPython {
        /// The interpreter, and why not.
        wanted: Looked,
    },
    /// The environment of a lambda is one that was tampered with.
    #[error("cannot read `{}`", config.display())]
    Environment {
        /// Its `pyvenv.cfg`.
        config: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A part is in none of its places.
    #[error("cannot find {part}; looked in{}", lines(folders.iter().map(|folder| folder.display().to_string())))]
    Missing {
        /// The part, for example `gleaner-runtime`.
        part: String,
        /// The folders that were looked at, in order.
        folders: Vec<PathBuf>,
        /// The command that makes the part in a checkout.
        made_by: &'static str,
    },
    /// No Python interpreter will do.
    #[error(
        "found no Python 3.9 or newer that runs; tried{}",
        lines(tried.iter().map(|tried| format!("{}: {}", tried.at.display(), tried.why)))
    )]
    NoPython {
        /// The candidates, in order.
        tried: Vec<Looked>,
    },
    /// There is no home to keep a cache in.
    #[error(
        "there is no folder for the cache: neither XDG_CACHE_HOME nor HOME is set to an absolute path"
    )]
    NoCache,
}

impl Explain for PartsError {
    fn help(&self) -> Option<String> {
        match self {
            PartsError::NoExecutable { .. } => None,
            PartsError::Home { .. } => Some("set GLEANER_HOME to the folder of the installation, or unset it".to_owned()),
            PartsError::WantedPython { .. } => Some(
                "set GLEANER_PYTHON to a Python 3.9 or newer that has venv and ensurepip, or unset it".to_owned(),
            ),
            PartsError::Environment { source, .. } => NotPlain::of(source)
                .map(|why| format!("{}: `python3 -m venv` writes a new one", why.help())),
            PartsError::Missing { made_by, .. } => {
                Some(format!("in a checkout run `{made_by}`, else set GLEANER_HOME to the folder of the installation"))
            }
            PartsError::NoPython { .. } => Some(
                "in a checkout run `cargo xtask demo`, or set GLEANER_PYTHON to a Python 3.9 or newer that has venv and ensurepip"
                    .to_owned(),
            ),
            PartsError::NoCache => Some("set XDG_CACHE_HOME".to_owned()),
        }
    }

    fn exit(&self) -> Exit {
        match self {
            PartsError::Home { .. }
            | PartsError::WantedPython { .. }
            | PartsError::Environment { .. } => Exit::Usage,
            _ => Exit::Internal,
        }
    }
}

/// Each item on a line of its own.
fn lines(items: impl Iterator<Item = String>) -> String {
    items.map(|item| format!("\n{item}")).collect()
}
