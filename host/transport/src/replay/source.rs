//! One file, read in pieces and never whole.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::error::{Damage, Place, ReplayError};

/// How much [`Source::peek`] reads at once. Record heads of small messages lie close together.
const WINDOW: usize = 64 * 1024;

/// An open file of known length.
pub(super) struct Source {
    file: File,
    path: PathBuf,
    len: u64,
    window: Vec<u8>,
    window_at: u64,
}

impl Source {
    pub(super) fn open(path: &Path) -> Result<Self, ReplayError> {
        let cannot = |source| ReplayError::Open { path: path.to_owned(), source };
        // Before it is opened: of a pipe, that would never end.
        let metadata = path.metadata().map_err(cannot)?;
        if metadata.is_dir() {
            return Err(ReplayError::Directory { path: path.to_owned() });
        }
        if !metadata.is_file() {
            return Err(cannot(io::Error::new(io::ErrorKind::InvalidInput, "it is no file")));
        }
        let file = File::open(path).map_err(cannot)?;
        let metadata = file.metadata().map_err(cannot)?;
        Ok(Self::over(file, path, metadata.len()))
    }

    /// What is in `file`, which has `len` bytes, under the name `path`.
    pub(super) fn over(file: File, path: &Path, len: u64) -> Self {
        Self { file, path: path.to_owned(), len, window: Vec::new(), window_at: 0 }
    }

    /// The file, to be read from its start.
    #[cfg(feature = "bags")]
    pub(super) fn into_file(mut self) -> io::Result<File> {
        self.file.rewind()?;
        Ok(self.file)
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn len(&self) -> u64 {
        self.len
    }

    pub(super) fn damaged(&self, offset: u64, what: Damage) -> ReplayError {
        ReplayError::Damaged { path: self.path.clone(), at: Place::Byte(offset), what }
    }

    /// Fills `into` with the bytes from `offset` on, which the caller knows to lie in the file.
    pub(super) fn read(&mut self, offset: u64, into: &mut [u8]) -> Result<(), ReplayError> {
        self.file
            .seek(SeekFrom::Start(offset))
            .and_then(|_| self.file.read_exact(into))
            .map_err(|source| self.failed(offset, source))
    }

    /// The `n` bytes at `offset` (at most [`WINDOW`]), or fewer where the file ends.
    pub(super) fn peek(&mut self, offset: u64, n: usize) -> Result<&[u8], ReplayError> {
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

    /// CRC-32 of the first `end` bytes.
    pub(super) fn checksum(&mut self, end: u64) -> Result<u32, ReplayError> {
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
