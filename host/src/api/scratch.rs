//! What the host keeps for a lambda, by name, within `scratch` of `[limits]`; the rules are those of `gleaner_rules::scratch`.
//!
//! Memory and no folder: so its bound is exact, no call waits for a disk, a replay finds what the vehicle found, and the jail around
//! the lambda needs no hole.

pub(super) use gleaner_rules::scratch::Scratch;
pub use gleaner_rules::scratch::{Entry, ScratchError};

use super::Session;

impl Session {
    /// Keeps `bytes` under a name, in place of what was there.
    ///
    /// # Errors
    ///
    /// [`ScratchError`]; nothing has changed then.
    pub fn put(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.lock().scratch.put(name, bytes)
    }

    /// Keeps `bytes` behind what is there already under that name.
    ///
    /// # Errors
    ///
    /// As [`Session::put`].
    pub fn append(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.lock().scratch.append(name, bytes)
    }

    /// Bytes from `offset`, `len` at most; clamped to what is there, and to `call_bytes` of `[limits]`.
    ///
    /// # Errors
    ///
    /// [`ScratchError::NoSuchEntry`].
    pub fn get(&self, name: &str, offset: u64, len: u64) -> Result<Vec<u8>, ScratchError> {
        self.lock().scratch.get(name, offset, len)
    }

    /// Forgets what is kept under a name.
    ///
    /// # Errors
    ///
    /// [`ScratchError::NoSuchEntry`].
    pub fn remove(&self, name: &str) -> Result<(), ScratchError> {
        self.lock().scratch.remove(name)
    }

    /// Everything that is kept, in the order of the names' bytes.
    pub fn entries(&self) -> Vec<Entry> {
        self.lock().scratch.entries()
    }

    /// Bytes for which there is room.
    pub fn free(&self) -> u64 {
        self.lock().scratch.free()
    }
}
