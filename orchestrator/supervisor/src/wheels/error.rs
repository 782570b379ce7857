//! Errors of wheels and environments, with help for the user.

use std::io;
use std::path::PathBuf;

use gleaner_base::programs::InstallationError;
use gleaner_base::{Exit, Explain, NotPlain};
use gleaner_lambda::LayoutError;
use zip::result::ZipError;

use crate::wheels::Interpreter;
use crate::wheels::archive::{FILES_MAX, UNPACKED_MAX};

/// The reason why a wheel is refused, or an environment cannot be made of wheels.
#[derive(Debug, thiserror::Error)]
pub enum WheelError {
    #[error("`{name}` is not the name of a wheel")]
    Name { name: String },
    #[error("cannot start the interpreter `{}`", python.display())]
    Start { python: PathBuf, source: io::Error },
    #[error("wheel `{wheel}` does not fit {interpreter}")]
    Unfit { wheel: String, interpreter: Box<Interpreter>, source: WheelTags },
    #[error("cannot read wheel `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("wheel `{wheel}` is not a zip archive that can be unpacked")]
    Archive { wheel: String, source: ZipError },
    #[error("wheel `{wheel}` has the entry `{entry}`, and {reason}")]
    Entry { wheel: String, entry: String, reason: &'static str },
    #[error("wheel `{wheel}` has no usable RECORD: {reason}")]
    Record { wheel: String, reason: String },
    #[error("file `{entry}` of wheel `{wheel}` is not as its RECORD lists it")]
    Differs { wheel: String, entry: String },
    #[error("cannot unpack wheel `{wheel}`")]
    Unpack { wheel: String, source: io::Error },
    #[error(
        "the wheels up to `{wheel}` have more than {FILES_MAX} files, or more than {UNPACKED_MAX}"
    )]
    TooMuch { wheel: String },
    #[error("{} different files `{entry}`", both(first, second, "two"))]
    Conflict { first: String, second: String, entry: String },
    #[error("{} a file and a folder `{entry}`", both(first, second, ""))]
    FileAndFolder { first: String, second: String, entry: String },
    #[error("cannot use the interpreter `{}`: {reason}", python.display())]
    Interpreter { python: PathBuf, reason: String },
    #[error("cannot {action} `{}`", path.display())]
    Environment { action: &'static str, path: PathBuf, source: io::Error },
    #[error(transparent)]
    Layout(#[from] LayoutError),
    #[error(transparent)]
    InstalledPrograms(#[from] InstallationError),
}

fn both(first: &str, second: &str, count: &str) -> String {
    match first == second {
        true => format!("wheel `{first}` has {count}").trim_end().to_owned(),
        false => format!("wheels `{first}` and `{second}` have"),
    }
}

/// The tags of a wheel, as the cause of a refusal.
#[derive(Debug, thiserror::Error)]
#[error("its tags are {wheel}; the interpreter takes {accepted}")]
pub struct WheelTags {
    pub(super) wheel: String,
    pub(super) accepted: String,
}

impl Explain for WheelError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Unfit { interpreter, .. } => format!(
                "build for this interpreter, then publish and deploy again: `gleaner build \
                 {} DIR`",
                interpreter.build_options()
            ),
            Self::Read { source, .. }
            | Self::Unpack { source, .. }
            | Self::Environment { source, .. } => match NotPlain::of(source) {
                Some(reason) => reason.help(),
                None => "check that the disk has room, and that its files can be read and \
                             written"
                    .to_owned(),
            },
            Self::TooMuch { .. } => "lock fewer packages in requirements.txt".to_owned(),
            Self::Conflict { first, second, .. } | Self::FileAndFolder { first, second, .. }
                if first != second =>
            {
                "lock only one of the two packages in requirements.txt".to_owned()
            }
            Self::Interpreter { .. } | Self::Start { .. } => {
                "install CPython 3.9 or newer, or name one: GLEANER_PYTHON=/path/to/python3"
                    .to_owned()
            }
            Self::Layout(error) => return error.help(),
            Self::InstalledPrograms(error) => return error.help(),
            Self::Name { name } if name.to_ascii_lowercase().ends_with(".whl") => {
                "name it as its author did: `PACKAGE-VERSION-PYTHON-ABI-PLATFORM.whl`".to_owned()
            }
            Self::Name { .. }
            | Self::Conflict { .. }
            | Self::FileAndFolder { .. }
            | Self::Archive { .. }
            | Self::Entry { .. }
            | Self::Record { .. }
            | Self::Differs { .. } => {
                "lock another version of the package in requirements.txt, or report the wheel to \
                 its author"
                    .to_owned()
            }
        })
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Layout(error) => error.exit(),
            Self::InstalledPrograms(error) => error.exit(),
            Self::Unpack { .. } | Self::Environment { .. } | Self::Start { .. } => Exit::Internal,
            Self::Read { source, .. } if NotPlain::of(source).is_none() => Exit::Internal,
            Self::Entry { .. } | Self::Differs { .. } => Exit::Denied,
            _ => Exit::Usage,
        }
    }
}
