//! The files of a replay: `decisions.jsonl`, `log.jsonl`, `summary.json`, and the journal where one is wanted.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use gleaner_protocol::journal::{self, End, Entry, Header, JournalError, Reader};
use gleaner_protocol::{Decision, Exit, Explain, Failure, Summary};
use serde::Serialize;

use crate::api::log::Line;

const SUMMARY: &str = "summary.json";

/// The files of a replay beside its clips.
pub(super) const RESULTS: [&str; 4] = ["clips.jsonl", "decisions.jsonl", "log.jsonl", SUMMARY];

/// Why results could not be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write `{}`", path.display())]
pub struct OutputError {
    path: PathBuf,
    source: io::Error,
}

impl Explain for OutputError {
    fn help(&self) -> Option<String> {
        Some("make room or choose another folder: --out DIR".to_owned())
    }

    fn exit(&self) -> Exit {
        Exit::Internal
    }
}

/// Open result files.
pub struct Output {
    folder: PathBuf,
    decisions: Lines,
    log: Lines,
    all: bool,
}

impl Output {
    /// Makes `folder` and starts its files anew. With `all`, decisions without trigger and fault are written too.
    pub fn create(folder: &Path, all: bool) -> Result<Self, OutputError> {
        fs::create_dir_all(folder).map_err(|source| OutputError { path: folder.to_owned(), source })?;
        // A summary says that the files beside it are whole.
        let summary = folder.join(SUMMARY);
        match fs::remove_file(&summary) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                return Err(OutputError { path: summary, source });
            }
            _ => {}
        }
        let decisions = Lines::create(folder.join("decisions.jsonl"))?;
        let log = Lines::create(folder.join("log.jsonl"))?;
        Ok(Self { folder: folder.to_owned(), decisions, log, all })
    }

    /// Writes a decision, if it is one to keep.
    pub fn decision(&mut self, decision: &Decision) -> Result<(), OutputError> {
        if self.all || !decision.triggers.is_empty() || decision.fault.is_some() {
            self.decisions.write(decision)?;
        }
        Ok(())
    }

    /// Writes what the lambda said.
    pub fn log(&mut self, lines: &[Line]) -> Result<(), OutputError> {
        lines.iter().try_for_each(|line| self.log.write(line))
    }

    /// Writes what waits, so that a reader sees how far the replay is.
    pub fn flush(&mut self) -> Result<(), OutputError> {
        self.decisions.flush()?;
        self.log.flush()
    }

    /// Completes the files and adds the summary.
    pub fn finish(mut self, summary: &Summary) -> Result<(), OutputError> {
        self.flush()?;
        let path = self.folder.join(SUMMARY);
        let mut text = serde_json::to_vec_pretty(summary).expect("a summary is plain data");
        text.push(b'\n');
        fs::write(&path, text).map_err(|source| OutputError { path, source })
    }
}

/// A file of lines. It grows by whole lines only, so that it can be read whenever this process ends.
struct Lines {
    path: PathBuf,
    file: File,
    pending: Vec<u8>,
}

/// Bytes that wait for the next write.
const PENDING_BYTES: usize = 64 << 10;

impl Lines {
    fn create(path: PathBuf) -> Result<Self, OutputError> {
        match File::create(&path) {
            Ok(file) => Ok(Self { path, file, pending: Vec::new() }),
            Err(source) => Err(OutputError { path, source }),
        }
    }

    fn write(&mut self, line: &impl Serialize) -> Result<(), OutputError> {
        let failed = |source| OutputError { path: self.path.clone(), source };
        serde_json::to_writer(&mut self.pending, line).map_err(io::Error::from).map_err(failed)?;
        self.pending.push(b'\n');
        if self.pending.len() < PENDING_BYTES { Ok(()) } else { self.flush() }
    }

    fn flush(&mut self) -> Result<(), OutputError> {
        let written = self.file.write_all(&self.pending);
        self.pending.clear();
        written.map_err(|source| OutputError { path: self.path.clone(), source })
    }
}

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
