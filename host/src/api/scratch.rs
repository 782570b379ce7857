//! Named entries that the host keeps for a lambda, within `scratch` of `[limits]`. The rules are in
//! `gleaner_rules::scratch`.
//!
//! Entries are in memory, not in a folder: so the limit is exact, no call waits for a disk, a
//! replay reads the same as the vehicle, and the sandbox needs no exception.

pub use gleaner_rules::scratch::Entry;
pub(super) use gleaner_rules::scratch::Scratch;
use gleaner_rules::scratch::ScratchError as Refusal;

use super::Session;
use super::fuel::OutOfFuel;

/// Cost of a list entry beside its name, in bytes.
const LISTED_BYTES: usize = 64;

/// A refused call; nothing has changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(transparent)]
pub enum ScratchError {
    Refused(#[from] Refusal),
    OutOfFuel(#[from] OutOfFuel),
}

/// Cases of `scratch-error` in `wit/scratch.wit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScratchErrorKind {
    NoRoom,
    NoSuchEntry,
    WrongName,
}

impl ScratchErrorKind {
    /// The name in the WIT.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoRoom => "no-room",
            Self::NoSuchEntry => "no-such-entry",
            Self::WrongName => "wrong-name",
        }
    }
}

impl ScratchError {
    /// The case that the lambda receives.
    pub fn kind(&self) -> ScratchErrorKind {
        match self {
            // A guest with a fuel allowance is ended instead.
            Self::Refused(Refusal::NoRoom { .. } | Refusal::TooMany(_)) | Self::OutOfFuel(_) => {
                ScratchErrorKind::NoRoom
            }
            Self::Refused(Refusal::NoSuchEntry(_)) => ScratchErrorKind::NoSuchEntry,
            Self::Refused(Refusal::WrongName(_)) => ScratchErrorKind::WrongName,
        }
    }
}

impl Session {
    /// Stores `bytes` under a name, and replaces an existing entry.
    ///
    /// # Errors
    ///
    /// [`ScratchError`]; nothing has changed then.
    pub fn put(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len() + bytes.len())?;
        Ok(self.lock().scratch.put(name, bytes)?)
    }

    /// Appends `bytes` to the entry of that name, or creates it. Fails as [`Session::put`]:
    /// nothing has changed then.
    pub fn append(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len() + bytes.len())?;
        Ok(self.lock().scratch.append(name, bytes)?)
    }

    /// Bytes from `offset`, `len` at most; clamped to the entry, and to `call_bytes` of `[limits]`.
    /// Fails if there is no such entry.
    pub fn get(&self, name: &str, offset: u64, len: u64) -> Result<Vec<u8>, ScratchError> {
        let got = self.lock().scratch.get(name, offset, len);
        self.fuel.charge(|| name.len() + got.as_ref().map_or(0, Vec::len))?;
        Ok(got?)
    }

    /// Removes the entry of a name. Fails if there is no such entry.
    pub fn remove(&self, name: &str) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len())?;
        Ok(self.lock().scratch.remove(name)?)
    }

    /// All entries, in the order of the names' bytes.
    pub fn entries(&self) -> Result<Vec<Entry>, OutOfFuel> {
        let entries = self.lock().scratch.entries();
        self.fuel.charge(|| entries.iter().map(|entry| LISTED_BYTES + entry.name.len()).sum())?;
        Ok(entries)
    }

    /// Number of bytes that are free.
    pub fn free(&self) -> u64 {
        self.lock().scratch.free()
    }
}
