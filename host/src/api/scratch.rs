//! What the host keeps for a lambda, by name, within `scratch` of `[limits]`; the rules are those
//! of `gleaner_rules::scratch`.
//!
//! Memory and no folder: so its bound is exact, no call waits for a disk, a replay finds what the
//! vehicle found, and the jail around the lambda needs no hole.

pub use gleaner_rules::scratch::Entry;
pub(super) use gleaner_rules::scratch::Scratch;
use gleaner_rules::scratch::ScratchError as Refusal;

use super::Session;
use super::fuel::OutOfFuel;

/// What an entry of the list costs besides its name.
const LISTED_BYTES: usize = 64;

/// Why something was not kept or not found.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(transparent)]
pub enum ScratchError {
    /// A rule of scratch refuses it.
    Refused(#[from] Refusal),
    /// The lambda cannot pay for the call.
    OutOfFuel(#[from] OutOfFuel),
}

/// Which of the refusals of `wit/scratch.wit` a lambda gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
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
    /// The refusal that a lambda gets.
    pub fn kind(&self) -> ScratchErrorKind {
        match self {
            // Whoever can end a guest for want of fuel ends it instead.
            Self::Refused(Refusal::NoRoom { .. } | Refusal::TooMany(_)) | Self::OutOfFuel(_) => {
                ScratchErrorKind::NoRoom
            }
            Self::Refused(Refusal::NoSuchEntry(_)) => ScratchErrorKind::NoSuchEntry,
            Self::Refused(Refusal::WrongName(_)) => ScratchErrorKind::WrongName,
        }
    }
}

impl Session {
    /// Keeps `bytes` under a name, in place of what was there.
    ///
    /// # Errors
    ///
    /// [`ScratchError`]; nothing has changed then.
    pub fn put(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len() + bytes.len())?;
        Ok(self.lock().scratch.put(name, bytes)?)
    }

    /// Keeps `bytes` behind what is there already under that name.
    ///
    /// # Errors
    ///
    /// As [`Session::put`].
    pub fn append(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len() + bytes.len())?;
        Ok(self.lock().scratch.append(name, bytes)?)
    }

    /// Bytes from `offset`, `len` at most; clamped to what is there, and to `call_bytes` of
    /// `[limits]`.
    ///
    /// # Errors
    ///
    /// [`ScratchError`] if there is no such entry.
    pub fn get(&self, name: &str, offset: u64, len: u64) -> Result<Vec<u8>, ScratchError> {
        let got = self.lock().scratch.get(name, offset, len);
        self.fuel.charge(|| name.len() + got.as_ref().map_or(0, Vec::len))?;
        Ok(got?)
    }

    /// Forgets what is kept under a name.
    ///
    /// # Errors
    ///
    /// [`ScratchError`] if there is no such entry.
    pub fn remove(&self, name: &str) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len())?;
        Ok(self.lock().scratch.remove(name)?)
    }

    /// Everything that is kept, in the order of the names' bytes.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn entries(&self) -> Result<Vec<Entry>, OutOfFuel> {
        let entries = self.lock().scratch.entries();
        self.fuel.charge(|| entries.iter().map(|entry| LISTED_BYTES + entry.name.len()).sum())?;
        Ok(entries)
    }

    /// Bytes for which there is room.
    pub fn free(&self) -> u64 {
        self.lock().scratch.free()
    }
}
