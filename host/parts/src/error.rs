use std::io;
use std::path::PathBuf;

use gleaner_base::{Exit, Explain, NotPlain};

/// A Python interpreter that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RejectedPython {
    /// Its path.
    pub path: PathBuf,
    /// The reason.
    pub reason: String,
}

/// Errors of finding a part of the installation.
#[derive(Debug, thiserror::Error)]
pub enum PartsError {
    /// The path of the running program is unknown.
    #[error("cannot find the path of this program")]
    NoExecutable {
        /// The cause.
        source: io::Error,
    },
    /// `GLEANER_HOME` is not an installation.
    #[error("GLEANER_HOME is `{}`, which is not an installation of Gleaner", home.display())]
    Home {
        /// The folder.
        home: PathBuf,
    },
    /// `GLEANER_PYTHON` cannot be used.
    #[error(
        "GLEANER_PYTHON is `{}`, which cannot be used: {}",
        wanted.path.display(),
        wanted.reason
    )]
    WantedPython {
        /// The interpreter and the reason.
        wanted: RejectedPython,
    },
    /// `pyvenv.cfg` of a lambda's environment is not a regular file.
    #[error("cannot read `{}`", config.display())]
    Environment {
        /// Its `pyvenv.cfg`.
        config: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// A part was not found.
    #[error(
        "cannot find {part}; searched in{}",
        lines(folders.iter().map(|folder| folder.display().to_string()))
    )]
    Missing {
        /// The part, for example `gleaner-runtime`.
        part: String,
        /// The searched folders, in order.
        folders: Vec<PathBuf>,
        /// The command that makes the part in a checkout.
        made_by: &'static str,
    },
    /// No Python interpreter can be used.
    #[error(
        "cannot find a working Python 3.9 or newer; tried{}",
        lines(tried.iter().map(|tried| format!("{}: {}", tried.path.display(), tried.reason)))
    )]
    NoPython {
        /// The candidates, in order.
        tried: Vec<RejectedPython>,
    },
    /// There is no folder for the cache.
    #[error("no folder for the cache: neither XDG_CACHE_HOME nor HOME is an absolute path")]
    NoCache,
}

impl Explain for PartsError {
    fn help(&self) -> Option<String> {
        match self {
            PartsError::NoExecutable { .. } => None,
            PartsError::Home { .. } => {
                Some("set GLEANER_HOME to the folder of the installation, or unset it".to_owned())
            }
            PartsError::WantedPython { .. } => Some(
                "set GLEANER_PYTHON to a Python 3.9 or newer with venv and ensurepip, or unset it"
                    .to_owned(),
            ),
            PartsError::Environment { source, .. } => NotPlain::of(source)
                .map(|why| format!("{}: `python3 -m venv` writes a new one", why.help())),
            PartsError::Missing { made_by, .. } => Some(format!(
                "in a checkout run `{made_by}`, else set GLEANER_HOME to the folder of the \
                     installation"
            )),
            PartsError::NoPython { .. } => Some(
                "in a checkout run `cargo xtask demo`, or set GLEANER_PYTHON to a Python 3.9 or \
                 newer with venv and ensurepip"
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
