//! A preroll in memory: one block of consecutive entries, each after a head of [`OVERHEAD`] bytes.

use std::collections::TryReserveError;
use std::hint::black_box;

use super::{EntryId, EntryMeta, EntrySource, OVERHEAD};

/// Entries begin at multiples of this.
const ALIGN: usize = 8;

/// Distance at which memory is touched, so that the system allocates it; no page is smaller.
const PAGE: usize = 4096;

pub(super) struct Ram {
    arena: Vec<u8>,
    /// Offset of the oldest entry.
    head: usize,
    /// Offset of the next entry.
    tail: usize,
    /// Offset of the newest entry, if there is one.
    newest: usize,
    /// End of the entries before the end of the block, if later ones are at its beginning.
    wrapped: Option<usize>,
    entries: usize,
    bytes: u64,
}

impl Ram {
    /// Creates a store of `bytes`. With `prefault`, the system allocates its memory at once.
    ///
    /// # Errors
    ///
    /// If the memory cannot be allocated.
    pub(super) fn new(bytes: usize, prefault: bool) -> Result<Ram, TryReserveError> {
        // Reserved first, as a failure below would end the process.
        Vec::<u8>::new().try_reserve_exact(bytes)?;
        // Zeroed memory is not touched by the allocation, so that a large block costs nothing
        // before it is filled.
        let mut arena = vec![0; bytes];
        if prefault {
            arena.iter_mut().step_by(PAGE).for_each(|byte| *black_box(byte) = 0);
        }
        Ok(Ram { arena, head: 0, tail: 0, newest: 0, wrapped: None, entries: 0, bytes: 0 })
    }

    pub(super) fn push(
        &mut self,
        held: &EntryMeta,
        bytes: &[u8],
        gone: &mut dyn FnMut(&EntryMeta),
    ) -> bool {
        if !self.fits(bytes.len()) {
            return false;
        }
        let need = size(bytes.len());
        let at = loop {
            if let Some(at) = self.room(need) {
                break at;
            }
            gone(&self.pop());
        };
        let (head, rest) = self.arena[at..at + need].split_at_mut(OVERHEAD);
        write_head(head, held);
        rest[..bytes.len()].copy_from_slice(bytes);
        self.newest = at;
        self.tail = at + need;
        self.entries += 1;
        self.bytes += need as u64;
        true
    }

    /// Returns the offset of `need` free bytes, if no entry has to be dropped.
    fn room(&mut self, need: usize) -> Option<usize> {
        if self.entries == 0 {
            (self.head, self.tail, self.wrapped) = (0, 0, None);
        }
        if self.wrapped.is_some() {
            return (self.head - self.tail >= need).then_some(self.tail);
        }
        if self.arena.len() - self.tail >= need {
            return Some(self.tail);
        }
        if self.head < need {
            return None;
        }
        self.wrapped = Some(self.tail);
        self.tail = 0;
        Some(0)
    }

    /// Removes the oldest entry, which exists: an empty store has room for every entry that fits.
    fn pop(&mut self) -> EntryMeta {
        let held = self.held(EntryId(self.head as u64));
        let size = size(held.len as usize);
        self.head += size;
        self.entries -= 1;
        self.bytes -= size as u64;
        if self.wrapped == Some(self.head) {
            (self.head, self.wrapped) = (0, None);
        }
        held
    }

    pub(super) fn trim(&mut self, before: i64, aged: &mut dyn FnMut(&EntryMeta)) {
        while self.entries > 0 && self.at_ns(self.head) < before {
            aged(&self.pop());
        }
    }

    pub(super) fn fits(&self, len: usize) -> bool {
        size(len) <= self.arena.len()
    }

    pub(super) fn entries(&self) -> u64 {
        self.entries as u64
    }

    pub(super) fn newest(&self) -> Option<EntryId> {
        (self.entries > 0).then_some(EntryId(self.newest as u64))
    }

    pub(super) fn oldest(&self) -> Option<EntryId> {
        (self.entries > 0).then_some(EntryId(self.head as u64))
    }

    pub(super) fn after(&self, place: EntryId) -> Option<EntryId> {
        let at = place.0 as usize;
        let end = at + size(u32_at(&self.arena, at + LEN) as usize);
        if self.wrapped == Some(end) && at >= self.head {
            return Some(EntryId(0));
        }
        (end != self.tail).then_some(EntryId(end as u64))
    }

    pub(super) fn held(&self, place: EntryId) -> EntryMeta {
        read_head(&self.arena[place.0 as usize..][..OVERHEAD])
    }

    pub(super) fn bytes(&self, place: EntryId) -> &[u8] {
        let at = place.0 as usize;
        &self.arena[at + OVERHEAD..][..u32_at(&self.arena, at + LEN) as usize]
    }

    pub(super) fn mark(&mut self, place: EntryId, group: u64) {
        self.arena[place.0 as usize + GROUP..][..8].copy_from_slice(&group.to_le_bytes());
    }

    pub(super) fn bytes_held(&self) -> u64 {
        self.bytes
    }

    fn at_ns(&self, at: usize) -> i64 {
        i64::from_le_bytes(bytes_at(&self.arena, at + AT))
    }
}

/// Returns the size of an entry of `len` bytes with its overhead, in bytes.
fn size(len: usize) -> usize {
    OVERHEAD + len.next_multiple_of(ALIGN)
}

// Offsets within the head of an entry.
const AT: usize = 0;
const PUBLISH: usize = 8;
const SEQ: usize = 16;
const GROUP: usize = 24;
const WRITER: usize = 32;
const SOURCE: usize = 48;
const LEN: usize = 52;
const OPTIONS: usize = 56;
const BIG: usize = 58;
const LAYOUT: usize = 60;

fn write_head(head: &mut [u8], held: &EntryMeta) {
    head[AT..][..8].copy_from_slice(&held.at_ns.to_le_bytes());
    head[PUBLISH..][..8].copy_from_slice(&held.publish_ns.to_le_bytes());
    head[SEQ..][..8].copy_from_slice(&held.seq.to_le_bytes());
    head[GROUP..][..8].copy_from_slice(&held.group.to_le_bytes());
    head[WRITER..][..16].copy_from_slice(&held.writer);
    head[SOURCE..][..4].copy_from_slice(&held.source.0.to_le_bytes());
    head[LEN..][..4].copy_from_slice(&held.len.to_le_bytes());
    head[OPTIONS..][..2].copy_from_slice(&held.options);
    head[BIG] = u8::from(held.is_big_endian);
    head[LAYOUT..][..2].copy_from_slice(&held.layout.to_le_bytes());
}

fn read_head(head: &[u8]) -> EntryMeta {
    EntryMeta {
        at_ns: i64::from_le_bytes(bytes_at(head, AT)),
        publish_ns: i64::from_le_bytes(bytes_at(head, PUBLISH)),
        seq: u64::from_le_bytes(bytes_at(head, SEQ)),
        group: u64::from_le_bytes(bytes_at(head, GROUP)),
        writer: bytes_at(head, WRITER),
        source: EntrySource(u32_at(head, SOURCE)),
        len: u32_at(head, LEN),
        options: bytes_at(head, OPTIONS),
        is_big_endian: head[BIG] != 0,
        layout: u16::from_le_bytes(bytes_at(head, LAYOUT)),
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes_at(bytes, at))
}

fn bytes_at<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    let mut found = [0; N];
    found.copy_from_slice(&bytes[at..][..N]);
    found
}
