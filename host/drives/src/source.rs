//! Reads one file in pieces, never as a whole.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::damage::{Damage, DamageLocation};
use crate::error::ReplayError;
use crate::inflate::ZSTD;
use crate::records::MAGIC;

/// Bytes that [`SourceFile::peek`] reads at once. Record heads of small messages are close
/// together.
const WINDOW: usize = 64 * 1024;

/// An open file of known length.
pub struct SourceFile {
    /// Read with explicit offsets: others may read it, too.
    file: Arc<File>,
    path: PathBuf,
    len: u64,
    window: Vec<u8>,
    window_at: u64,
}

impl SourceFile {
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        let cannot = |source| ReplayError::Open { path: path.to_owned(), source };
        // Checked before it is opened: opening a pipe would block for ever.
        let metadata = path.metadata().map_err(cannot)?;
        if metadata.is_dir() {
            return Err(ReplayError::Directory { path: path.to_owned() });
        }
        if !metadata.is_file() {
            return Err(cannot(io::Error::new(
                io::ErrorKind::InvalidInput,
                "it is not a regular file",
            )));
        }
        Self::over(Arc::new(File::open(path).map_err(cannot)?), path)
    }

    /// Opens the content of `file`, under the name `path`.
    pub fn over(file: Arc<File>, path: &Path) -> Result<Self, ReplayError> {
        let path = path.to_owned();
        match file.metadata() {
            Ok(metadata) => {
                Ok(Self { file, path, len: metadata.len(), window: Vec::new(), window_at: 0 })
            }
            Err(source) => Err(ReplayError::Open { path, source }),
        }
    }

    /// Returns the file, whose own position is still at its start.
    #[cfg(feature = "bags")]
    pub fn into_file(self) -> Arc<File> {
        self.file
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn len(&self) -> u64 {
        self.len
    }

    pub fn damaged(&self, offset: u64, what: Damage) -> ReplayError {
        ReplayError::Damaged { path: self.path.clone(), at: DamageLocation::Byte(offset), what }
    }

    /// Fills `into` with the bytes from `offset` on, which the caller knows to be in the file.
    pub fn read(&mut self, offset: u64, into: &mut [u8]) -> Result<(), ReplayError> {
        self.file.read_exact_at(into, offset).map_err(|source| self.failed(offset, source))
    }

    /// Returns the `n` bytes at `offset` (at most [`WINDOW`]), or fewer at the end of the file.
    pub fn peek(&mut self, offset: u64, n: usize) -> Result<&[u8], ReplayError> {
        let left = self.len.saturating_sub(offset);
        let n = n.min(usize::try_from(left).unwrap_or(usize::MAX)).min(WINDOW);
        let inside = offset
            .checked_sub(self.window_at)
            .and_then(|start| usize::try_from(start).ok())
            .filter(|start| start.checked_add(n).is_some_and(|end| end <= self.window.len()));
        let start = match inside {
            Some(start) => start,
            None => {
                let len = WINDOW.min(usize::try_from(left).unwrap_or(usize::MAX));
                let mut window = std::mem::take(&mut self.window);
                window.resize(len, 0);
                self.read(offset, &mut window)?;
                self.window = window;
                self.window_at = offset;
                0
            }
        };
        Ok(&self.window[start..start + n])
    }

    /// Returns the CRC-32 of the first `end` bytes.
    pub fn checksum(&mut self, end: u64) -> Result<u32, ReplayError> {
        let mut hasher = crc32fast::Hasher::new();
        let mut piece = vec![0; WINDOW];
        let mut at = 0;
        while at < end {
            let n = WINDOW.min(usize::try_from(end - at).unwrap_or(WINDOW));
            self.read(at, &mut piece[..n])?;
            hasher.update(&piece[..n]);
            at += n as u64;
        }
        Ok(hasher.finalize())
    }

    fn failed(&self, offset: u64, source: io::Error) -> ReplayError {
        ReplayError::Read { path: self.path.clone(), offset, source }
    }
}

/// Format of a file, by its first bytes, as file names are not reliable.
pub enum FileKind {
    Mcap,
    Database,
    Packed,
}

/// Number of bytes that determine the format.
pub const START: usize = 16;

impl FileKind {
    pub fn of(start: &[u8]) -> Option<Self> {
        if start.starts_with(MAGIC) {
            Some(Self::Mcap)
        } else if start == b"SQLite format 3\0" {
            Some(Self::Database)
        } else if start.starts_with(&ZSTD) {
            Some(Self::Packed)
        } else {
            None
        }
    }
}
