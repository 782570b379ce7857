//! The journal of a replay, where one is wanted.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use gleaner_protocol::journal::{self, End, Entry, Header, JournalError, Reader};
use gleaner_protocol::{Exit, Failure};

use crate::stage::OutputError;

/// Whether a file begins as a journal does, be it of another version, damaged or cut off: such a one may be replaced.
fn is_journal(path: &Path) -> bool {
    let opened = File::open(path).map(Reader::open);
    opened.is_ok_and(|opened| !matches!(opened, Err(JournalError::NotAJournal | JournalError::Read { .. })))
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
        match fs::metadata(path) {
            Ok(metadata) => {
                // A pipe would never end, and a device is no file to verify later.
                let is_file = metadata.is_file();
                if !is_file || metadata.len() > 0 && !is_journal(path) {
                    let message = format!("`{}` is there and is no journal", path.display());
                    return Err(Failure::new(Exit::Usage, message).with_help("choose another name: --journal FILE"));
                }
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(failed(error).into()),
        }
        let file = File::create(path).map_err(failed)?;
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
