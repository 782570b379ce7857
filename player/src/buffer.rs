//! Message buffers: passed on without copying, and reused when DDS releases them.

use std::mem;
use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Maximum bytes that a pool keeps for reuse. The kernel maps and clears a 25 MB frame on each
/// allocation; with a depth of ten, this much is released at once.
const KEPT_BYTES: usize = 256 << 20;

/// The bytes of one message. On drop, in any thread, they return to their pool.
#[derive(Debug, Default)]
pub(crate) struct Buffer {
    bytes: Vec<u8>,
    pool: Option<Pool>,
}

impl From<Vec<u8>> for Buffer {
    fn from(bytes: Vec<u8>) -> Buffer {
        Buffer { bytes, pool: None }
    }
}

impl Deref for Buffer {
    type Target = Vec<u8>;

    fn deref(&self) -> &Vec<u8> {
        &self.bytes
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut Vec<u8> {
        &mut self.bytes
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        if let Some(pool) = self.pool.take() {
            pool.put(mem::take(&mut self.bytes));
        }
    }
}

/// A pool of buffers of similar size.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pool(Arc<Mutex<Vec<Vec<u8>>>>);

impl Pool {
    /// Returns a buffer with room for `len` bytes: a used one, with its old content, or an empty
    /// one.
    pub(crate) fn take(&self, len: usize) -> Buffer {
        let mut kept = self.kept();
        let fits = |bytes: &Vec<u8>| bytes.capacity() >= len && bytes.capacity() / 2 <= len;
        let found = kept.iter().rposition(fits).map(|index| kept.swap_remove(index));
        drop(kept);
        Buffer { bytes: found.unwrap_or_else(|| Vec::with_capacity(len)), pool: Some(self.clone()) }
    }

    fn put(&self, bytes: Vec<u8>) {
        let mut kept = self.kept();
        // Buffers of another size are no longer needed and make room for this one.
        while kept.iter().map(Vec::capacity).sum::<usize>() + bytes.capacity() > KEPT_BYTES
            && !kept.is_empty()
        {
            kept.remove(0);
        }
        if bytes.capacity() <= KEPT_BYTES {
            kept.push(bytes);
        }
    }

    /// A list of vectors stays valid even if a thread panicked while it held the lock.
    fn kept(&self) -> MutexGuard<'_, Vec<Vec<u8>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_comes_back_with_its_content() {
        let pool = Pool::default();
        let mut first = pool.take(100);
        assert!(first.is_empty());
        first.extend([7; 100]);
        let at = first.as_ptr();
        drop(first);
        let second = pool.take(90);
        assert_eq!((second.as_ptr(), second.as_slice()), (at, &[7; 100][..]));
        assert!(pool.take(90).is_empty(), "a buffer is lent only once");
    }

    #[test]
    fn a_buffer_far_too_large_is_not_used_for_a_small_message() {
        let pool = Pool::default();
        drop(pool.take(1000));
        assert!(pool.take(100).capacity() < 1000);
    }

    #[test]
    fn a_pool_keeps_a_bounded_number_of_bytes() {
        let pool = Pool::default();
        let taken: Vec<_> = (0..5).map(|_| pool.take(KEPT_BYTES / 4)).collect();
        drop(taken);
        assert_eq!(pool.kept().len(), 4);
    }
}
