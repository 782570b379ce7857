//! Memory for samples: mapped from the kernel, touched before the first sample, and unmapped as a
//! whole.
//!
//! The allocator is not used. glibc keeps large blocks once it has seen one freed: a process that
//! replayed ten times grew from 8.6 to 13.1 MB in WebAssembly, and from 52 to 61 MB in Python.
#![allow(unsafe_code)]

use std::io;
use std::ptr::{self, NonNull};

use gleaner_buffers::Region;
#[cfg(target_env = "gnu")]
use gleaner_protocol::process_stats::own::LARGE_BYTES;
use rustix::mm::{MapFlags, ProtFlags, mmap_anonymous, munmap};

/// Makes the allocator map each large block and unmap it when it is freed, which is also its
/// initial behaviour. Call it once, at the start of a program.
pub fn map_large_blocks() {
    #[cfg(target_env = "gnu")]
    // SAFETY: `mallopt` takes two numbers by value and locks what it changes. It fails only for an
    // unknown parameter, and then nothing has changed.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BYTES as libc::c_int);
    }
}

/// Returns freed memory that the allocator keeps to the system.
pub fn trim_heap() {
    #[cfg(target_env = "gnu")]
    // SAFETY: `malloc_trim` takes a number by value, and locks what it releases, which is unused.
    unsafe {
        libc::malloc_trim(0);
    }
}

/// Zeroed memory, private to this process.
pub struct Mapping {
    base: NonNull<u8>,
    len: usize,
}

impl Mapping {
    /// Maps `len` bytes, 1 at least, with every page present.
    ///
    /// # Errors
    ///
    /// The kernel's error: out of memory, or an address space that is too small.
    pub fn populated(len: usize) -> io::Result<Self> {
        let len = len.max(1);
        let flags = MapFlags::PRIVATE | MapFlags::POPULATE;
        // SAFETY: a null hint lets the kernel choose addresses that nothing else uses.
        let base = unsafe {
            mmap_anonymous(ptr::null_mut(), len, ProtFlags::READ | ProtFlags::WRITE, flags)
        }?;
        let base = NonNull::new(base.cast()).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Self { base, len })
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: `populated` mapped exactly these bytes, and a pool drops its region after the
        // last lease. It fails only for arguments that no mapping has.
        let _ = unsafe { munmap(self.base.as_ptr().cast(), self.len) };
    }
}

// SAFETY: the mapping is owned, at a fixed place, readable and writable for `len` bytes until it is
// dropped, and reached only through the pool that owns it.
unsafe impl Region for Mapping {
    fn base(&self) -> NonNull<u8> {
        self.base
    }

    fn len(&self) -> usize {
        self.len
    }
}

// SAFETY: bytes have no thread of their own; the pool that owns the mapping controls access to
// them.
unsafe impl Send for Mapping {}
// SAFETY: as above; a shared `Mapping` exposes only its address and length.
unsafe impl Sync for Mapping {}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_buffers::Pool;

    #[test]
    fn a_pool_over_a_mapping_holds_what_was_written() {
        let bytes = Pool::<u32>::bytes_needed(2, 100).unwrap();
        let pool = Pool::new(Mapping::populated(bytes).unwrap(), 2, 100).unwrap();
        let mut draft = pool.draft(3).unwrap();
        assert_eq!(*draft, [0; 3]);
        draft.copy_from_slice(b"abc");
        let lease = draft.seal(7);
        drop(pool);
        assert_eq!((&*lease, *lease.meta()), (b"abc".as_slice(), 7));
    }

    #[test]
    fn more_than_the_address_space_is_an_error() {
        assert!(Mapping::populated(usize::MAX / 2).is_err());
    }
}
