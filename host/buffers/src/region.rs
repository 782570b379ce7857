//! The memory that a pool is built over, owned by one value, and the heap as its first kind.
#![allow(unsafe_code)]

use std::{
    alloc::{Layout, alloc_zeroed, dealloc},
    ptr::NonNull,
};

use crate::PoolError;

/// The smallest page of the supported platforms. Touching memory more often than needed costs
/// little, less often a page fault.
const PAGE: usize = 4096;

/// A block of memory for a pool.
///
/// # Safety
///
/// For as long as the value lives, even if it is moved: both methods return the same value each
/// time; the `len` bytes from `base` are initialised and valid for reads and writes from any
/// thread; and only the pool or topic that owns it writes them.
#[expect(
    clippy::len_without_is_empty,
    reason = "a pool only checks that the region is large enough"
)]
pub unsafe trait Region: Send + Sync + 'static {
    /// Returns its first byte.
    fn base(&self) -> NonNull<u8>;
    /// Returns its size in bytes.
    fn len(&self) -> usize;
}

/// Page-aligned heap memory, resident from the start.
#[derive(Debug)]
pub struct HeapRegion {
    base: NonNull<u8>,
    layout: Layout,
}

impl HeapRegion {
    /// Allocates `len` zeroed bytes, at least 1. Every page has been written to, so that no later
    /// write causes a page fault.
    pub fn zeroed(len: usize) -> Result<Self, PoolError> {
        let refused = PoolError::OutOfMemory { bytes: len };
        let layout = Layout::from_size_align(len.max(1), PAGE).map_err(|_| refused)?;
        // SAFETY: the size of `layout` is at least 1.
        let base = NonNull::new(unsafe { alloc_zeroed(layout) }).ok_or(refused)?;
        for offset in (0..layout.size()).step_by(PAGE) {
            // Volatile, because a compiler may remove a plain write of 0 to zeroed memory. SAFETY:
            // `offset` is below the size of the block allocated above.
            unsafe { base.add(offset).write_volatile(0) };
        }
        Ok(Self { base, layout })
    }
}

// SAFETY: the block is allocated zeroed, is not moved until drop, and only the pool reads or writes
// it.
unsafe impl Region for HeapRegion {
    fn base(&self) -> NonNull<u8> {
        self.base
    }

    fn len(&self) -> usize {
        self.layout.size()
    }
}

// SAFETY: a heap block belongs to no thread, and the methods only read two plain values.
unsafe impl Send for HeapRegion {}
// SAFETY: as above.
unsafe impl Sync for HeapRegion {}

impl Drop for HeapRegion {
    fn drop(&mut self) {
        // SAFETY: allocated in `zeroed` with this layout, and freed here only.
        unsafe { dealloc(self.base.as_ptr(), self.layout) }
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;

    #[test]
    fn a_heap_region_is_page_aligned_and_zero() {
        let region = HeapRegion::zeroed(3 * PAGE + 5).unwrap();
        assert_eq!(region.len(), 3 * PAGE + 5);
        assert_eq!(region.base().as_ptr() as usize % PAGE, 0);
        // SAFETY: `region` lives, and nothing writes to it.
        let bytes = unsafe { std::slice::from_raw_parts(region.base().as_ptr(), region.len()) };
        assert!(bytes.iter().all(|&byte| byte == 0));
    }

    #[test]
    fn a_region_beyond_the_address_space_is_refused_with_its_size() {
        let refused = HeapRegion::zeroed(usize::MAX).unwrap_err();
        assert_eq!(refused, PoolError::OutOfMemory { bytes: usize::MAX });
    }
}
