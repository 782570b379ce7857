//! Bytes that the host keeps by name, beyond a fault of the lambda: `gleaner:lambda/scratch`.

use crate::Result;
use crate::bindings::gleaner::lambda::scratch as wit;
pub use crate::bindings::gleaner::lambda::scratch::{Entry, ScratchError};
use crate::error::answer;

/// Keeps `bytes` under a name, in place of what was there.
///
/// # Errors
///
/// `no-room` beyond `scratch` of `[limits]` or 1,024 entries; `wrong-name`. Nothing has changed
/// then.
pub fn put(name: &str, bytes: &[u8]) -> Result<()> {
    answer(wit::put(name, bytes))
}

/// Keeps `bytes` behind what is there already under that name, if anything is.
///
/// # Errors
///
/// As [`put`].
pub fn append(name: &str, bytes: &[u8]) -> Result<()> {
    answer(wit::append(name, bytes))
}

/// Bytes from `offset`, `len` at most; clamped to what is there, and to `call_bytes` of `[limits]`,
/// 1 MiB by default.
///
/// # Errors
///
/// `no-such-entry`.
pub fn get(name: &str, offset: u64, len: u32) -> Result<Vec<u8>> {
    answer(wit::get(name, offset, len))
}

/// Forgets what is kept under a name.
///
/// # Errors
///
/// `no-such-entry`.
pub fn remove(name: &str) -> Result<()> {
    answer(wit::remove(name))
}

/// Everything that is kept, in the order of the names' bytes.
pub fn entries() -> Vec<Entry> {
    wit::entries()
}

/// Bytes for which there is room. An entry takes its length, the length of its name and 64 bytes.
pub fn free() -> u64 {
    wit::free()
}
