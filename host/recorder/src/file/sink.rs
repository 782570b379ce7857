//! The file of an MCAP writer.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Records around chunks are written in many small pieces, which are collected up to this size.
const BUFFER: usize = 64 << 10;

/// An append-only file that rejects writes after a failed one: data after a torn record would be
/// unreadable.
pub(super) struct FileSink {
    file: File,
    buffer: Vec<u8>,
    position: Arc<AtomicU64>,
    failed: bool,
}

impl FileSink {
    /// Creates a sink that writes to the new file `file`.
    pub(super) fn new(file: File) -> Self {
        Self { file, buffer: Vec::with_capacity(BUFFER), position: Arc::default(), failed: false }
    }

    /// Flushes and returns the file.
    pub(super) fn into_file(mut self) -> io::Result<File> {
        self.flush()?;
        Ok(self.file)
    }

    /// Returns the number of bytes written so far, readable while an MCAP writer owns the sink.
    pub(super) fn position(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.position)
    }

    fn check(&self) -> io::Result<()> {
        if self.failed {
            Err(io::Error::other("an earlier write to this file failed"))
        } else {
            Ok(())
        }
    }

    fn through(&mut self, bytes: &[u8]) -> io::Result<()> {
        let written = self.file.write_all(bytes);
        self.failed |= written.is_err();
        written
    }

    fn empty(&mut self) -> io::Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        let written = if buffer.is_empty() { Ok(()) } else { self.through(&buffer) };
        buffer.clear();
        self.buffer = buffer;
        written
    }
}

impl Write for FileSink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.check()?;
        if self.buffer.len() + bytes.len() > BUFFER {
            self.empty()?;
        }
        if bytes.len() > BUFFER {
            self.through(bytes)?;
        } else {
            self.buffer.extend_from_slice(bytes);
        }
        self.position.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.check()?;
        self.empty()
    }
}

impl Seek for FileSink {
    /// Returns the position. The MCAP writer requests nothing else, so every other seek is refused.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Current(0) => Ok(self.position.load(Ordering::Relaxed)),
            _ => Err(io::ErrorKind::Unsupported.into()),
        }
    }
}
