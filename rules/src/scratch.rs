//! Scratch: named bytes that the host keeps for a lambda, up to `scratch` of `[limits]`.

use std::collections::BTreeMap;
use std::fmt;

use crate::text::visible;

const NAME_BYTES: usize = 128;
const ENTRIES: usize = 1024;
/// Charge for each entry besides its name and its bytes, about the overhead of the host.
const ENTRY_BYTES: u64 = 64;
/// Length of the pieces in which bytes are kept, so that no call moves more than that.
const PIECE_BYTES: usize = 1 << 20;

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ScratchError {
    /// The entry needs this many additional bytes, and this many are free.
    NoRoom {
        name: String,
        needed: u64,
        free: u64,
    },
    /// With this entry, there would be too many.
    TooMany(String),
    NoSuchEntry(String),
    WrongName(String),
}

impl fmt::Display for ScratchError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoRoom { name, needed, free } => {
                write!(f, "`{name}` needs {needed} bytes of scratch and {free} are free; ")?;
                write!(f, "remove entries, or raise `scratch` in [limits]")
            }
            Self::TooMany(name) => {
                write!(f, "cannot add `{name}`: scratch has {ENTRIES} entries, the maximum; ")?;
                write!(f, "remove some, or append to one of them")
            }
            Self::NoSuchEntry(name) => {
                write!(f, "scratch has no `{name}`; it is empty when the lambda's process starts")
            }
            Self::WrongName(name) => {
                write!(
                    f,
                    "`{name}` is not a name for scratch; \
                     give 1 to 128 bytes without control characters"
                )
            }
        }
    }
}

impl std::error::Error for ScratchError {}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    pub name: String,
    /// Length of the value in bytes.
    pub bytes: u64,
}

/// Entries by name, with their total size.
pub struct Scratch {
    granted: u64,
    call_bytes: usize,
    used: u64,
    entries: BTreeMap<String, Pieces>,
}

impl Scratch {
    /// Creates a store for `granted` bytes; one call returns at most `call_bytes`.
    pub fn new(granted: u64, call_bytes: usize) -> Self {
        Self { granted, call_bytes, used: 0, entries: BTreeMap::new() }
    }

    /// Returns the number of free bytes.
    pub fn free(&self) -> u64 {
        self.granted - self.used
    }

    /// Returns all entries, sorted by the bytes of their names.
    pub fn entries(&self) -> Vec<Entry> {
        self.entries
            .iter()
            .map(|(name, pieces)| Entry { name: name.clone(), bytes: pieces.len() })
            .collect()
    }

    /// Stores `bytes` under a name; replaces an existing entry.
    ///
    /// # Errors
    ///
    /// [`ScratchError`]; then nothing has changed.
    pub fn put(&mut self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.keep(name, bytes, true)
    }

    /// Appends `bytes` to the entry of that name, which is created if it does not exist.
    ///
    /// # Errors
    ///
    /// As [`Scratch::put`].
    pub fn append(&mut self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.keep(name, bytes, false)
    }

    /// Appends `bytes` to an entry, or replaces it.
    fn keep(&mut self, name: &str, bytes: &[u8], in_place: bool) -> Result<(), ScratchError> {
        if name.is_empty() || name.len() > NAME_BYTES || name.chars().any(char::is_control) {
            return Err(ScratchError::WrongName(shown(name)));
        }
        let existing = self.entries.get(name).map(Pieces::len);
        if existing.is_none() && self.entries.len() >= ENTRIES {
            return Err(ScratchError::TooMany(shown(name)));
        }
        let released = if in_place { existing.unwrap_or(0) } else { 0 };
        let new = existing.map_or(ENTRY_BYTES + name.len() as u64, |_| 0) + bytes.len() as u64;
        let no_room = |free| ScratchError::NoRoom {
            name: shown(name),
            needed: new.saturating_sub(released),
            free,
        };
        if new > self.free() + released {
            return Err(no_room(self.free()));
        }
        // An existing entry stays until the new one is complete.
        let made = match self.entries.get_mut(name).filter(|_| !in_place) {
            Some(pieces) => pieces.append(bytes),
            None => {
                let mut pieces = Pieces::default();
                let made = pieces.append(bytes);
                if made {
                    self.entries.insert(name.to_owned(), pieces);
                }
                made
            }
        };
        if !made {
            // The process may have less memory than granted.
            return Err(no_room(0));
        }
        self.used = self.used + new - released;
        Ok(())
    }

    /// Returns up to `len` bytes from `offset`, clamped to the entry and to the limit of one call.
    ///
    /// # Errors
    ///
    /// [`ScratchError::NoSuchEntry`].
    pub fn get(&self, name: &str, offset: u64, len: u64) -> Result<Vec<u8>, ScratchError> {
        let pieces =
            self.entries.get(name).ok_or_else(|| ScratchError::NoSuchEntry(shown(name)))?;
        let from = offset.min(pieces.len());
        let len = len.min(pieces.len() - from).min(self.call_bytes as u64);
        Ok(pieces.read(from as usize, len as usize))
    }

    /// Removes an entry.
    ///
    /// # Errors
    ///
    /// [`ScratchError::NoSuchEntry`].
    pub fn remove(&mut self, name: &str) -> Result<(), ScratchError> {
        let pieces =
            self.entries.remove(name).ok_or_else(|| ScratchError::NoSuchEntry(shown(name)))?;
        self.used -= ENTRY_BYTES + name.len() as u64 + pieces.len();
        Ok(())
    }
}

/// Formats a name, valid or not, for a message.
fn shown(name: &str) -> String {
    visible(&name.chars().take(NAME_BYTES).collect::<String>())
}

/// Bytes in pieces, all but the last of which are full.
#[derive(Default)]
struct Pieces(Vec<Vec<u8>>);

impl Pieces {
    fn len(&self) -> u64 {
        let full = self.0.len().saturating_sub(1) * PIECE_BYTES;
        (full + self.0.last().map_or(0, Vec::len)) as u64
    }

    /// Appends `bytes`. Returns `false` if there is no memory for them; then nothing was added.
    fn append(&mut self, mut bytes: &[u8]) -> bool {
        let before = self.len();
        while !bytes.is_empty() {
            if self.0.last().is_none_or(|piece| piece.len() == PIECE_BYTES) {
                self.0.push(Vec::new());
            }
            let piece = self.0.last_mut().expect("a piece was added if there was none");
            let (now, later) = bytes.split_at(bytes.len().min(PIECE_BYTES - piece.len()));
            if piece.capacity() - piece.len() < now.len() {
                // Doubles the capacity, up to a piece.
                let more = now.len().max(piece.len().min(PIECE_BYTES - piece.len()));
                if piece.try_reserve_exact(more).is_err() {
                    self.cut(before);
                    return false;
                }
            }
            piece.extend_from_slice(now);
            bytes = later;
        }
        true
    }

    fn cut(&mut self, len: u64) {
        let len = len as usize;
        self.0.truncate(len.div_ceil(PIECE_BYTES));
        if let Some(last) = self.0.last_mut() {
            last.truncate(len - (len - 1) / PIECE_BYTES * PIECE_BYTES);
        }
    }

    /// Returns `len` bytes from `from`, which must exist.
    fn read(&self, mut from: usize, len: usize) -> Vec<u8> {
        let mut read = Vec::with_capacity(len);
        while read.len() < len {
            let piece = &self.0[from / PIECE_BYTES][from % PIECE_BYTES..];
            let some = &piece[..piece.len().min(len - read.len())];
            read.extend_from_slice(some);
            from += some.len();
        }
        read
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_continue_across_pieces_and_a_call_returns_at_most_its_limit() {
        let mut scratch = Scratch::new(8 << 20, 1 << 20);
        let bytes: Vec<u8> = (0..3_000_000_u32).map(|n| (n % 251) as u8).collect();
        for part in bytes.chunks(700_001) {
            scratch.append("long", part).unwrap();
        }
        let at = PIECE_BYTES - 3;
        assert_eq!(scratch.get("long", at as u64, 7).unwrap(), bytes[at..at + 7]);
        assert_eq!(scratch.get("long", 0, u64::MAX).unwrap(), bytes[..1 << 20]);
        let read: Vec<u8> = (0..)
            .step_by(1 << 20)
            .map(|from| scratch.get("long", from, 1 << 20).unwrap())
            .take(3)
            .flatten()
            .collect();
        assert!(read == bytes);
    }

    #[test]
    fn cutting_restores_the_earlier_bytes() {
        for len in [0, 1, PIECE_BYTES - 1, PIECE_BYTES, PIECE_BYTES + 1, 2 * PIECE_BYTES] {
            let mut pieces = Pieces::default();
            let bytes: Vec<u8> = (0..len).map(|n| n as u8).collect();
            assert!(pieces.append(&bytes) && pieces.append(&vec![9; PIECE_BYTES + 5]));
            pieces.cut(len as u64);
            assert_eq!(pieces.len(), len as u64);
            assert!(pieces.read(0, len) == bytes);
        }
    }
}
