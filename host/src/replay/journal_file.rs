//! The journal of a replay, where one is wanted.

use std::fs::File;
use std::io::Seek;
use std::path::{Path, PathBuf};

use gleaner_protocol::journal::{self, End, Entry, Header, JournalError, Reader};
use gleaner_protocol::own_file::{self, InTheWay};
use gleaner_protocol::{Exit, Failure};

use crate::stage::OutputError;

/// Opens the file `path` for a journal; it is made if there is none.
///
/// # Errors
///
/// A failure that names it.
pub(super) fn open(path: &Path) -> Result<File, Failure> {
    own_file::write(path).map_err(|source| match InTheWay::of(&source) {
        // A pipe would never end, a device is no file to verify later, and a link leads to what is not named here.
        Some(why) => {
            let mut failure = no_journal(path);
            failure.causes = vec![why.to_string()];
            failure
        }
        None => OutputError { path: path.to_owned(), source }.into(),
    })
}

fn no_journal(path: &Path) -> Failure {
    let message = format!("`{}` is there and is no journal", path.display());
    Failure::new(Exit::Usage, message).with_help("choose another name: --journal FILE")
}

/// Whether a file begins as a journal does, be it of another version, damaged or cut off: such a one may be replaced.
fn is_journal(file: &File) -> bool {
    !matches!(Reader::open(file), Err(JournalError::NotAJournal | JournalError::Read { .. }))
}

/// The journal of a replay.
pub struct JournalFile {
    path: PathBuf,
    writer: journal::Writer<File>,
}

impl JournalFile {
    /// Begins the journal `path` anew. A file there that is no journal is left alone: it may be a drive, named by mistake.
    pub fn create(path: &Path, header: &Header) -> Result<Self, Failure> {
        let failed = |source| OutputError { path: path.to_owned(), source };
        let mut file = open(path)?;
        if file.metadata().map_err(failed)?.len() > 0 && !is_journal(&file) {
            return Err(no_journal(path));
        }
        file.set_len(0).and_then(|()| file.rewind()).map_err(failed)?;
        let writer = journal::Writer::begin(file, header).map_err(failed)?;
        Ok(Self { path: path.to_owned(), writer })
    }

    /// Adds a wake.
    pub fn wake(&mut self, entry: &Entry) -> Result<(), OutputError> {
        self.writer.wake(entry).map_err(|source| OutputError { path: self.path.clone(), source })
    }

    /// Writes what waits.
    pub fn flush(&mut self) -> Result<(), OutputError> {
        self.writer.flush().map_err(|source| OutputError { path: self.path.clone(), source })
    }

    /// Ends the journal. Without `end` it reads like one whose writer died.
    pub fn finish(mut self, end: Option<&End>) -> Result<(), OutputError> {
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
    fn a_journal_is_made_and_a_link_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let [journal, target, link] = ["drive.journal", "target", "link"].map(|name| folder.path().join(name));
        open(&journal).unwrap();
        assert_eq!(fs::read(&journal).unwrap(), b"");
        std::os::unix::fs::symlink(&target, &link).unwrap();
        let failure = open(&link).unwrap_err();
        let text = failure.to_string();
        assert!(text.contains("link` is there and is no journal") && text.contains("it is a link"), "{text}");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(!target.exists());
        fs::hard_link(&journal, &target).unwrap();
        assert!(open(&target).unwrap_err().to_string().contains("the file has other names"));
    }
}
