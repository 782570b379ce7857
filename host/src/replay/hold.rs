//! The folder of the results, held by one replay at a time: those of two, mixed, would look like
//! those of one.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::own_file::{self, InTheWay};
use gleaner_base::{Exit, Explain};

use crate::stage::LOCK;

/// The folder of the results, for as long as this lives.
pub(super) struct Hold {
    _lock: File,
}

/// Why the folder is not to be had.
#[derive(Debug, thiserror::Error)]
pub(super) enum HoldError {
    #[error("another replay writes into `{}`", folder.display())]
    Busy { folder: PathBuf },
    #[error("cannot lock `{}`", path.display())]
    Lock { path: PathBuf, source: io::Error },
}

impl Hold {
    /// Takes `out`, which is made if there is none. Its lock stays there: who removed it could
    /// remove that of another.
    pub(super) fn take(out: &Path) -> Result<Self, HoldError> {
        let path = out.join(LOCK);
        let lock = match fs::create_dir_all(out).and_then(|()| own_file::write(&path)) {
            Ok(lock) => lock,
            Err(source) => return Err(HoldError::Lock { path, source }),
        };
        match lock.try_lock() {
            Ok(()) => Ok(Self { _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(HoldError::Busy { folder: out.to_owned() }),
            Err(TryLockError::Error(source)) => Err(HoldError::Lock { path, source }),
        }
    }
}

impl Explain for HoldError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Busy { .. } => {
                "wait until it ends, or choose another folder: --out DIR".to_owned()
            }
            Self::Lock { source, .. } if InTheWay::of(source).is_some() => {
                InTheWay::HELP.to_owned()
            }
            Self::Lock { .. } => "choose a folder that you may write to: --out DIR".to_owned(),
        })
    }

    fn exit(&self) -> Exit {
        Exit::Internal
    }
}
