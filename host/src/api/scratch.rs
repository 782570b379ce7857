//! What the host keeps for a lambda, by name, within `scratch` of `[limits]`.
//!
//! Memory and no folder: so its bound is exact, no call waits for a disk, a replay finds what the vehicle found, and the jail around
//! the lambda needs no hole.

use std::collections::BTreeMap;

use gleaner_protocol::manifest::Limits;
use gleaner_protocol::visible;

use super::Session;
use super::fuel::OutOfFuel;

/// Longest name, in bytes.
const NAME_BYTES: usize = 128;
/// Most entries.
const ENTRIES: usize = 1024;
/// What an entry takes beside its name and its bytes: about what it costs the host.
const ENTRY_BYTES: u64 = 64;
/// What an entry of the list costs besides its name.
const LISTED_BYTES: usize = 64;
/// Bytes are kept in pieces of so many, so that no call moves more than that.
const PIECE_BYTES: usize = 1 << 20;

/// Why something was not kept or not found.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ScratchError {
    /// It would take more than is granted.
    #[error(
        "`{name}` needs {needed} bytes of scratch and {free} are free; remove entries, or ask for more by `scratch` in [limits]"
    )]
    NoRoom {
        /// What was to be kept.
        name: String,
        /// Bytes that it would take in addition.
        needed: u64,
        /// Bytes that are free.
        free: u64,
    },
    /// There are as many entries as there can be.
    #[error("there is no room for `{0}` beside 1024 entries; remove some, or append to one of them")]
    TooMany(String),
    /// Nothing has that name.
    #[error("scratch has no `{0}`; it is empty when the lambda's process starts")]
    NoSuchEntry(String),
    /// A name that cannot be one.
    #[error("`{0}` is no name for scratch; give 1 to 128 bytes without control characters")]
    WrongName(String),
    /// The lambda cannot pay for the call.
    #[error(transparent)]
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
            Self::NoRoom { .. } | Self::TooMany(_) | Self::OutOfFuel(_) => ScratchErrorKind::NoRoom,
            Self::NoSuchEntry(_) => ScratchErrorKind::NoSuchEntry,
            Self::WrongName(_) => ScratchErrorKind::WrongName,
        }
    }
}

/// Something that is kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// Its length in bytes.
    pub bytes: u64,
}

/// Entries by name, and what they take.
pub(super) struct Scratch {
    granted: u64,
    most_given: usize,
    used: u64,
    entries: BTreeMap<String, Pieces>,
}

impl Scratch {
    pub(super) fn new(limits: &Limits) -> Self {
        let (granted, most_given) = (limits.scratch.bytes(), limits.call_bytes.as_usize());
        Self { granted, most_given, used: 0, entries: BTreeMap::new() }
    }

    fn free(&self) -> u64 {
        self.granted - self.used
    }

    /// Keeps `bytes` behind what is there, or in place of it.
    fn keep(&mut self, name: &str, bytes: &[u8], in_place: bool) -> Result<(), ScratchError> {
        if name.is_empty() || name.len() > NAME_BYTES || name.chars().any(char::is_control) {
            return Err(ScratchError::WrongName(shown(name)));
        }
        let there = self.entries.get(name).map(Pieces::len);
        if there.is_none() && self.entries.len() >= ENTRIES {
            return Err(ScratchError::TooMany(shown(name)));
        }
        let given_back = if in_place { there.unwrap_or(0) } else { 0 };
        let new = there.map_or(ENTRY_BYTES + name.len() as u64, |_| 0) + bytes.len() as u64;
        let no_room = |free| ScratchError::NoRoom { name: shown(name), needed: new.saturating_sub(given_back), free };
        if new > self.free() + given_back {
            return Err(no_room(self.free()));
        }
        // What was there stays until all of the new is made.
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
            // The process may not have what it was granted.
            return Err(no_room(0));
        }
        self.used = self.used + new - given_back;
        Ok(())
    }

    fn get(&self, name: &str, offset: u64, len: u64) -> Result<Vec<u8>, ScratchError> {
        let pieces = self.entries.get(name).ok_or_else(|| ScratchError::NoSuchEntry(shown(name)))?;
        let from = offset.min(pieces.len());
        let len = len.min(pieces.len() - from).min(self.most_given as u64);
        Ok(pieces.read(from as usize, len as usize))
    }

    fn remove(&mut self, name: &str) -> Result<(), ScratchError> {
        let pieces = self.entries.remove(name).ok_or_else(|| ScratchError::NoSuchEntry(shown(name)))?;
        self.used -= ENTRY_BYTES + name.len() as u64 + pieces.len();
        Ok(())
    }
}

/// A name in a message, which may be none that can be.
fn shown(name: &str) -> String {
    visible(&name.chars().take(NAME_BYTES).collect::<String>())
}

/// Bytes in pieces, of which all but the last are full.
#[derive(Default)]
struct Pieces(Vec<Vec<u8>>);

impl Pieces {
    fn len(&self) -> u64 {
        let full = self.0.len().saturating_sub(1) * PIECE_BYTES;
        (full + self.0.last().map_or(0, Vec::len)) as u64
    }

    /// Adds `bytes`; false if there is no memory for them, and nothing was added.
    fn append(&mut self, mut bytes: &[u8]) -> bool {
        let before = self.len();
        while !bytes.is_empty() {
            if self.0.last().is_none_or(|piece| piece.len() == PIECE_BYTES) {
                self.0.push(Vec::new());
            }
            let piece = self.0.last_mut().expect("one was there, or was made");
            let (now, later) = bytes.split_at(bytes.len().min(PIECE_BYTES - piece.len()));
            if piece.capacity() - piece.len() < now.len() {
                // Twice as much each time, and never beyond a piece.
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

    /// `len` bytes from `from`, all of which are there.
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

impl Session {
    /// Keeps `bytes` under a name, in place of what was there.
    ///
    /// # Errors
    ///
    /// [`ScratchError`]; nothing has changed then.
    pub fn put(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len() + bytes.len())?;
        self.lock().scratch.keep(name, bytes, true)
    }

    /// Keeps `bytes` behind what is there already under that name.
    ///
    /// # Errors
    ///
    /// As [`Session::put`].
    pub fn append(&self, name: &str, bytes: &[u8]) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len() + bytes.len())?;
        self.lock().scratch.keep(name, bytes, false)
    }

    /// Bytes from `offset`, `len` at most; clamped to what is there, and to `call_bytes` of `[limits]`.
    ///
    /// # Errors
    ///
    /// [`ScratchError::NoSuchEntry`].
    pub fn get(&self, name: &str, offset: u64, len: u64) -> Result<Vec<u8>, ScratchError> {
        let got = self.lock().scratch.get(name, offset, len);
        self.fuel.charge(|| name.len() + got.as_ref().map_or(0, Vec::len))?;
        got
    }

    /// Forgets what is kept under a name.
    ///
    /// # Errors
    ///
    /// [`ScratchError::NoSuchEntry`].
    pub fn remove(&self, name: &str) -> Result<(), ScratchError> {
        self.fuel.charge(|| name.len())?;
        self.lock().scratch.remove(name)
    }

    /// Everything that is kept, in the order of the names' bytes.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn entries(&self) -> Result<Vec<Entry>, OutOfFuel> {
        let state = self.lock();
        let entries = &state.scratch.entries;
        self.fuel.charge(|| entries.keys().map(|name| LISTED_BYTES + name.len()).sum())?;
        Ok(entries.iter().map(|(name, pieces)| Entry { name: name.clone(), bytes: pieces.len() }).collect())
    }

    /// Bytes for which there is room.
    pub fn free(&self) -> u64 {
        self.lock().scratch.free()
    }
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::manifest::ByteSize;

    use super::*;

    fn session(scratch: ByteSize) -> Session {
        let mut limits = Limits::default();
        limits.scratch = scratch;
        Session::new(Vec::new(), Vec::new(), &limits)
    }

    #[test]
    fn what_is_kept_is_found_and_what_is_put_takes_its_place() {
        let session = session(ByteSize::mib(8));
        session.put("b", b"one").unwrap();
        session.append("b", b", two").unwrap();
        session.append("a", b"new").unwrap();
        assert_eq!(session.get("b", 0, 100).unwrap(), b"one, two");
        assert_eq!(session.get("b", 5, 2).unwrap(), b"tw");
        assert_eq!(session.get("b", 1 << 40, 2).unwrap(), b"");
        let entry = |name: &str, bytes| Entry { name: name.to_owned(), bytes };
        assert_eq!(session.entries().unwrap(), [entry("a", 3), entry("b", 8)]);
        session.put("b", b"").unwrap();
        assert_eq!(session.entries().unwrap(), [entry("a", 3), entry("b", 0)]);
        session.remove("b").unwrap();
        assert_eq!(session.remove("b"), Err(ScratchError::NoSuchEntry("b".to_owned())));
        assert_eq!(session.get("b", 0, 1), Err(ScratchError::NoSuchEntry("b".to_owned())));
        session.remove("a").unwrap();
        assert_eq!(session.free(), 8 << 20);
    }

    #[test]
    fn bytes_go_on_from_piece_to_piece_and_a_call_gives_no_more_than_its_limit() {
        let session = session(ByteSize::mib(8));
        let bytes: Vec<u8> = (0..3_000_000_u32).map(|n| (n % 251) as u8).collect();
        for part in bytes.chunks(700_001) {
            session.append("long", part).unwrap();
        }
        let at = PIECE_BYTES - 3;
        assert_eq!(session.get("long", at as u64, 7).unwrap(), bytes[at..at + 7]);
        assert_eq!(session.get("long", 0, u64::MAX).unwrap(), bytes[..1 << 20]);
        let read: Vec<u8> =
            (0..).step_by(1 << 20).map(|from| session.get("long", from, 1 << 20).unwrap()).take(3).flatten().collect();
        assert!(read == bytes);
    }

    #[test]
    fn room_is_exact_and_a_refusal_changes_nothing() {
        let session = session(ByteSize::kib(1));
        let room = 1024 - ENTRY_BYTES as usize - 1;
        session.put("x", &vec![1; room]).unwrap();
        assert_eq!(session.free(), 0);
        let error = session.append("x", b"y").unwrap_err();
        assert_eq!(error, ScratchError::NoRoom { name: "x".to_owned(), needed: 1, free: 0 });
        assert!(session.put("x", &vec![2; room + 1]).is_err() && session.put("y", b"").is_err());
        assert_eq!(session.get("x", 0, 2000).unwrap(), vec![1; room]);
        // In its own place there is room for as much.
        session.put("x", &vec![3; room]).unwrap();
        session.put("x", b"short").unwrap();
        assert_eq!(session.free() as usize, room - 5);
        // Without a grant there is none at all.
        assert!(self::session(ByteSize::kib(0)).put("x", b"").is_err());
    }

    #[test]
    fn names_are_short_and_few() {
        let session = session(ByteSize::mib(8));
        for name in ["", "a\nb", &"x".repeat(129)] {
            assert!(matches!(session.put(name, b""), Err(ScratchError::WrongName(_))), "{name:?}");
        }
        for n in 0..ENTRIES {
            session.put(&format!("{n}"), b"").unwrap();
        }
        assert!(matches!(session.put("one more", b""), Err(ScratchError::TooMany(_))));
        session.put("7", b"again").unwrap();
    }

    #[test]
    fn what_is_cut_back_is_what_was_there() {
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
