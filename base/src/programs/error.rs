use std::io;
use std::path::PathBuf;

use crate::{Exit, Explain, NotPlain};

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RejectedPython {
    pub path: PathBuf,
    pub reason: String,
}

#[derive(Debug, thiserror::Error)]
pub enum InstallationError {
    #[error("cannot find the path of this program")]
    NoExecutable { source: io::Error },
    #[error("GLEANER_HOME is `{}`, which is not an installation of Gleaner", home.display())]
    Home { home: PathBuf },
    #[error(
        "GLEANER_PYTHON is `{}`, which cannot be used: {}",
        wanted.path.display(),
        wanted.reason
    )]
    WantedPython { wanted: RejectedPython },
    /// `pyvenv.cfg` of a lambda's environment is not a regular file.
    #[error("cannot read `{}`", config.display())]
    Environment { config: PathBuf, source: io::Error },
    #[error(
        "cannot find {part}; searched in{}",
        lines(folders.iter().map(|folder| folder.display().to_string()))
    )]
    Missing {
        /// The part, for example `gleaner-runtime`.
        part: String,
        folders: Vec<PathBuf>,
        /// The command that makes the part in a checkout.
        made_by: &'static str,
    },
    #[error(
        "cannot find a working Python 3.9 or newer; tried{}",
        lines(tried.iter().map(|tried| format!("{}: {}", tried.path.display(), tried.reason)))
    )]
    NoPython { tried: Vec<RejectedPython> },
    #[error("no folder for the cache: neither XDG_CACHE_HOME nor HOME is an absolute path")]
    NoCache,
}

impl Explain for InstallationError {
    fn help(&self) -> Option<String> {
        match self {
            InstallationError::NoExecutable { .. } => None,
            InstallationError::Home { .. } => {
                Some("set GLEANER_HOME to the folder of the installation, or unset it".to_owned())
            }
            InstallationError::WantedPython { .. } => Some(
                "set GLEANER_PYTHON to a Python 3.9 or newer with venv and ensurepip, or unset it"
                    .to_owned(),
            ),
            InstallationError::Environment { source, .. } => NotPlain::of(source)
                .map(|why| format!("{}: `python3 -m venv` writes a new one", why.help())),
            InstallationError::Missing { made_by, .. } => Some(format!(
                "in a checkout run `{made_by}`, else set GLEANER_HOME to the folder of the \
                     installation"
            )),
            InstallationError::NoPython { .. } => Some(
                "in a checkout run `cargo xtask demo`, or set GLEANER_PYTHON to a Python 3.9 or \
                 newer with venv and ensurepip"
                    .to_owned(),
            ),
            InstallationError::NoCache => Some("set XDG_CACHE_HOME".to_owned()),
        }
    }

    fn exit(&self) -> Exit {
        match self {
            InstallationError::Home { .. }
            | InstallationError::WantedPython { .. }
            | InstallationError::Environment { .. } => Exit::Usage,
            _ => Exit::Internal,
        }
    }
}

/// Each item on a line of its own.
fn lines(items: impl Iterator<Item = String>) -> String {
    items.map(|item| format!("\n{item}")).collect()
}
