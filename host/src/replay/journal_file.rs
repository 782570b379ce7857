//! The journal file of a replay.

use std::fs::{File, TryLockError};
use std::io::{self, Seek};
use std::path::{Path, PathBuf};

use gleaner_base::safe_file::{self, UnsafePath};
use gleaner_base::{Exit, Explain, Failure};
use gleaner_journal as journal;
use gleaner_journal::{JournalEnd, JournalEntry, JournalError, JournalHeader, JournalReader};

use crate::session_setup::OutputError;

/// Opens the file `path` for a journal, and creates it if there is none.
pub(super) fn open(path: &Path) -> Result<File, Failure> {
    safe_file::write(path).map_err(|source| match UnsafePath::of(&source) {
        // A pipe would never end, a device cannot be verified later, and a link leads to a file
        // that the user did not name.
        Some(why) => {
            let mut failure = no_journal(path);
            failure.causes = vec![why.to_string()];
            failure
        }
        None => OutputError { path: path.to_owned(), source }.into(),
    })
}

#[derive(Debug, thiserror::Error)]
enum JournalLockError {
    #[error("another process writes or verifies journal `{}`", path.display())]
    Busy { path: PathBuf },
    #[error("cannot lock journal `{}`", path.display())]
    Lock { path: PathBuf, source: io::Error },
}

impl Explain for JournalLockError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Busy { .. } => {
                "wait until it ends, or choose another file: --journal FILE".to_owned()
            }
            Self::Lock { .. } => {
                "choose a file on a file system that has locks: --journal FILE".to_owned()
            }
        })
    }
}

/// Opens the journal `path` for reading. While it is open, no replay writes into it.
///
/// # Errors
///
/// A failure that names it; also while a replay writes into it, since its end would look like
/// damage.
pub(super) fn read(path: &Path) -> Result<File, Failure> {
    let file = safe_file::read_named(path).map_err(|error| {
        Failure::caused_by(Exit::Usage, format!("cannot open journal `{}`", path.display()), &error)
            .with_help("name a file that `gleaner replay --journal FILE` wrote")
    })?;
    match file.try_lock_shared() {
        Err(TryLockError::WouldBlock) => {
            let message = format!("a replay is writing journal `{}`", path.display());
            Err(Failure::new(Exit::Usage, message).with_help("wait until it ends"))
        }
        // On a file system without locks, a journal can still be read.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(file),
    }
}

fn no_journal(path: &Path) -> Failure {
    let message = format!("`{}` exists and is not a journal", path.display());
    Failure::new(Exit::Usage, message).with_help("choose another name: --journal FILE")
}

/// Returns whether a file begins like a journal, which may be of another version, damaged or
/// truncated: such a file may be replaced.
fn is_journal(file: &File) -> bool {
    !matches!(JournalReader::open(file), Err(JournalError::NotAJournal | JournalError::Read { .. }))
}

pub struct JournalFile {
    path: PathBuf,
    writer: journal::JournalWriter<File>,
}

impl JournalFile {
    /// Creates or replaces the journal `path`. An existing file that is no journal is kept: it may
    /// be a drive that was named by mistake.
    pub fn create(path: &Path, header: &JournalHeader) -> Result<Self, Failure> {
        let failed = |source| OutputError { path: path.to_owned(), source };
        let mut file = open(path)?;
        // A journal that another process writes must not be truncated. The lock is held as long as
        // the file is open.
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(JournalLockError::Busy { path: path.to_owned() }.into());
            }
            Err(TryLockError::Error(source)) => {
                return Err(JournalLockError::Lock { path: path.to_owned(), source }.into());
            }
        }
        if file.metadata().map_err(failed)?.len() > 0 && !is_journal(&file) {
            return Err(no_journal(path));
        }
        file.set_len(0).and_then(|()| file.rewind()).map_err(failed)?;
        let writer = journal::JournalWriter::begin(file, header).map_err(failed)?;
        Ok(Self { path: path.to_owned(), writer })
    }

    /// Adds a wake. One with triggers is flushed at once, since its clip may be listed next.
    pub fn wake(&mut self, entry: &JournalEntry) -> Result<(), OutputError> {
        let written = self.writer.wake(entry);
        let written = written
            .and_then(|()| if entry.triggers.is_empty() { Ok(()) } else { self.writer.flush() });
        written.map_err(|source| OutputError { path: self.path.clone(), source })
    }

    /// Flushes buffered entries. If this is done at times of the wall clock, journals of equal
    /// replays differ.
    pub fn flush(&mut self) -> Result<(), OutputError> {
        self.writer.flush().map_err(|source| OutputError { path: self.path.clone(), source })
    }

    /// Ends the journal. Without `end`, readers see a journal whose writer died.
    pub fn finish(mut self, end: Option<&JournalEnd>) -> Result<(), OutputError> {
        let failed = |source| OutputError { path: self.path.clone(), source };
        match end {
            Some(end) => self.writer.finish(end).map(drop).map_err(failed),
            None => self.flush(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_journal_is_created_and_a_link_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [journal, target, link] =
            ["drive.journal", "target", "link"].map(|name| folder.path().join(name));
        open(&journal).unwrap();
        assert_eq!(fs::read(&journal).unwrap(), b"");
        std::os::unix::fs::symlink(&target, &link).unwrap();
        let failure = open(&link).unwrap_err();
        let text = failure.to_string();
        assert!(text.contains("link` exists and is not a journal"), "{text}");
        assert!(text.contains("it is a link"), "{text}");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(!target.exists());
        fs::hard_link(&journal, &target).unwrap();
        assert!(open(&target).unwrap_err().to_string().contains("the file has other hard links"));
    }
}
