//! The file of an MCAP writer.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use gleaner_trust::ContentDigest;

/// Records around chunks are written in many small pieces, which are collected up to this size.
const BUFFER: usize = 64 << 10;

/// An append-only file that rejects writes after a failed one: data after a torn record would be
/// unreadable.
pub(super) struct FileSink {
    file: File,
    buffer: Vec<u8>,
    position: Arc<AtomicU64>,
    failed: bool,
    /// The digest of the written bytes, of a file that will be signed.
    content: Option<ContentDigest>,
    /// Set once further bytes are held.
    is_held: Arc<AtomicBool>,
    /// The end of the file, which is written once it is signed.
    held: Vec<u8>,
}

impl FileSink {
    /// Creates a sink that writes to the new file `file`, which will be signed if `is_signed`.
    pub(super) fn new(file: File, is_signed: bool) -> Self {
        Self {
            file,
            buffer: Vec::with_capacity(BUFFER),
            position: Arc::default(),
            failed: false,
            content: is_signed.then(ContentDigest::default),
            is_held: Arc::default(),
            held: Vec::new(),
        }
    }

    /// Returns a flag, for use while an MCAP writer owns the sink: once it is set, further bytes
    /// are held, until [`complete`](Self::complete) writes them.
    pub(super) fn hold(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.is_held)
    }

    /// Writes the held bytes, which `sign` may change before; it also gets the digest of those
    /// before them. Flushes, and returns the file.
    pub(super) fn complete(
        mut self,
        sign: impl FnOnce(&ContentDigest, &mut [u8]),
    ) -> io::Result<File> {
        self.flush()?;
        let mut held = std::mem::take(&mut self.held);
        if let Some(content) = self.content.take().filter(|_| !held.is_empty()) {
            sign(&content, &mut held);
        }
        self.through(&held)?;
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
        if self.is_held.load(Ordering::Relaxed) {
            self.held.extend_from_slice(bytes);
        } else {
            if self.buffer.len() + bytes.len() > BUFFER {
                self.empty()?;
            }
            if bytes.len() > BUFFER {
                self.through(bytes)?;
            } else {
                self.buffer.extend_from_slice(bytes);
            }
            if let Some(content) = &mut self.content {
                content.update(bytes);
            }
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
