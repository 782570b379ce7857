//! Named byte strings that the host keeps for the lambda, also across its faults:
//! `gleaner:lambda/scratch`.
//!
//! The size of this scratch memory is `scratch` in `[limits]`, 0 bytes by default. It is empty when
//! the lambda's process starts. A fault of the lambda does not change it, and `init` may read and
//! write it.

use crate::Result;
pub use crate::error::ScratchErrorKind;
use crate::error::into_result;
use crate::world::gleaner::lambda::scratch as wit;
pub use crate::world::gleaner::lambda::scratch::{Entry, ScratchError};

/// Stores `bytes` under a name; replaces an existing entry.
///
/// # Errors
///
/// `no-room` if the entries would exceed `scratch` in `[limits]`, or there are 1,024 entries
/// already; `wrong-name` unless the name has 1 to 128 bytes and no control characters. The call has
/// no effect then.
pub fn put(name: &str, bytes: &[u8]) -> Result<()> {
    into_result(wit::put(name, bytes))
}

/// Appends `bytes` to the entry of that name; creates a missing one.
///
/// # Errors
///
/// As [`put`].
pub fn append(name: &str, bytes: &[u8]) -> Result<()> {
    into_result(wit::append(name, bytes))
}

/// Returns bytes of an entry: at most `len`, from `offset`, clamped to the entry and to
/// `call_bytes` in `[limits]`, 1 MiB by default.
///
/// # Errors
///
/// `no-such-entry`.
pub fn get(name: &str, offset: u64, len: u32) -> Result<Vec<u8>> {
    into_result(wit::get(name, offset, len))
}

/// Deletes an entry.
///
/// # Errors
///
/// `no-such-entry`.
pub fn remove(name: &str) -> Result<()> {
    into_result(wit::remove(name))
}

/// Returns all entries, sorted by the bytes of their names.
pub fn entries() -> Vec<Entry> {
    wit::entries()
}

/// Returns the free space in bytes. An entry takes the lengths of its value and its name, plus 64
/// bytes.
pub fn free() -> u64 {
    wit::free()
}
