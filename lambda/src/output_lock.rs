//! Locks the folder of the results for one replay at a time: mixed results of two would look like
//! those of one.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::Explain;
use gleaner_base::safe_file::{self, UnsafePath};

pub(crate) const LOCK: &str = ".lock";

/// The lock on a folder of results, held until it is dropped.
pub struct OutputLock {
    _lock: File,
}

#[derive(Debug, thiserror::Error)]
pub enum OutputLockError {
    #[error("another replay writes into `{}`", folder.display())]
    Busy { folder: PathBuf },
    #[error("cannot lock `{}`", path.display())]
    Lock { path: PathBuf, source: io::Error },
}

impl OutputLock {
    /// Creates `out` if necessary, and locks it. The lock file stays: its removal could remove the
    /// lock of another replay.
    ///
    /// # Errors
    ///
    /// [`OutputLockError`].
    pub fn take(out: &Path) -> Result<Self, OutputLockError> {
        let path = out.join(LOCK);
        let lock = match fs::create_dir_all(out).and_then(|()| safe_file::write(&path)) {
            Ok(lock) => lock,
            Err(source) => return Err(OutputLockError::Lock { path, source }),
        };
        match lock.try_lock() {
            Ok(()) => Ok(Self { _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(OutputLockError::Busy { folder: out.to_owned() }),
            Err(TryLockError::Error(source)) => Err(OutputLockError::Lock { path, source }),
        }
    }
}

impl Explain for OutputLockError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Busy { .. } => {
                "wait until it ends, or choose another folder: --out DIR".to_owned()
            }
            Self::Lock { source, .. } if UnsafePath::of(source).is_some() => {
                UnsafePath::HELP.to_owned()
            }
            Self::Lock { .. } => "choose a folder that you may write to: --out DIR".to_owned(),
        })
    }
}
