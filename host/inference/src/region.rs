//! Memory that a lambda shares with this process, for inputs or outputs.
//!
//! It is never mapped here: bytes are copied in and out by calls, so that the other process cannot
//! change them after they were checked.

use std::fs::File;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::FileExt;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};

const MIN_BYTES: u64 = 4096;

/// A region of fixed size.
#[derive(Debug)]
pub(crate) struct TensorRegion {
    /// Above 0, and unique in this process.
    pub(crate) id: u64,
    file: File,
    bytes: u64,
}

static LAST_ID: AtomicU64 = AtomicU64::new(0);

impl TensorRegion {
    /// Creates a region of zeros for `bytes` bytes, whose size is sealed. It is a power of two: so
    /// all regions of a lambda, which keeps the earlier ones, have at most twice the size of the
    /// largest.
    pub(crate) fn create(name: &str, bytes: u64) -> io::Result<Self> {
        let bytes = bytes.max(MIN_BYTES).next_power_of_two();
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let file = File::from(memfd_create(name, flags)?);
        file.set_len(bytes)?;
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?;
        let id = LAST_ID.fetch_add(1, Ordering::Relaxed) + 1;
        Ok(Self { id, file, bytes })
    }

    pub(crate) fn bytes(&self) -> u64 {
        self.bytes
    }

    pub(crate) fn read(&self, offset: u64, copy: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(copy, offset)
    }

    pub(crate) fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all_at(bytes, offset)
    }
}

impl AsFd for TensorRegion {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_copied_and_the_size_stays() {
        let region = TensorRegion::create("test", 5000).unwrap();
        region.write(64, b"abc").unwrap();
        let mut copy = [9; 4];
        region.read(64, &mut copy).unwrap();
        assert_eq!(&copy, b"abc\0");
        assert_eq!(region.bytes(), 8192);
        assert!(region.read(8191, &mut [0; 2]).is_err() && region.write(8191, b"ab").is_err());
        for size in [0, 8191, 8193] {
            assert!(region.file.set_len(size).is_err(), "{size}");
        }
    }
}
