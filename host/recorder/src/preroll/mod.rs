//! The preroll buffer: recent entries in arrival order, within a bound of bytes and of time. Clips
//! begin there before their trigger.
//!
//! One store has all entries, and does not depend on windows. Its reader goes from the oldest to
//! the newest and marks the entries that it has written to a clip, so that none is written twice.

mod disk;
mod losses;
mod ram;

use std::path::PathBuf;

use gleaner_lambda::manifest::Store;
use gleaner_messages::Endian;
use gleaner_messages::transport::{Guid, SampleMeta};

pub use losses::Losses;

use crate::RecordError;
use disk::Disk;
use ram::Ram;

/// Overhead of every entry beside its bytes.
pub const OVERHEAD: usize = 64;

/// The source of an entry: a topic, or the wakes of a lambda.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct EntrySource(u32);

/// The bit that distinguishes wakes from topics.
const WAKES: u32 = 1 << 31;

impl EntrySource {
    /// Creates the source of the samples of a topic, by its number.
    pub fn topic(index: usize) -> EntrySource {
        // Topics and lambdas are counted in hundreds.
        EntrySource(u32::try_from(index).unwrap_or(WAKES - 1) & !WAKES)
    }

    /// Creates the source of the wakes of a lambda, by its number.
    pub fn wakes(lambda: usize) -> EntrySource {
        EntrySource(EntrySource::topic(lambda).0 | WAKES)
    }

    /// Returns the number of the lambda, if these are wakes.
    pub fn lambda(self) -> Option<usize> {
        (self.0 & WAKES != 0).then_some((self.0 & !WAKES) as usize)
    }

    /// Returns the number of the topic, if it is one.
    pub fn as_topic(self) -> Option<usize> {
        (self.0 & WAKES == 0).then_some(self.0 as usize)
    }
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct EntryMeta {
    pub source: EntrySource,
    /// Length of the entry, in bytes.
    pub len: u32,
    /// The stamp that windows are compared with.
    pub at_ns: i64,
    /// Publication time; for a wake 0.
    pub publish_ns: i64,
    /// Sequence number, or the number of the wake.
    pub seq: u64,
    /// The group of windows whose clips have it, 0 for none.
    pub group: u64,
    /// The GUID of the writer; for a wake zeros.
    pub writer: [u8; 16],
    /// Options of the encapsulation.
    pub options: [u8; 2],
    pub is_big_endian: bool,
    pub layout: u16,
}

impl EntryMeta {
    pub fn sample(topic: usize, meta: &SampleMeta, group: u64) -> EntryMeta {
        EntryMeta {
            source: EntrySource::topic(topic),
            len: 0,
            at_ns: meta.at_ns,
            publish_ns: meta.publish_ns,
            seq: meta.seq,
            group,
            writer: meta.writer.0,
            options: meta.options,
            is_big_endian: meta.endian == Endian::Big,
            layout: meta.layout,
        }
    }

    /// Creates the metadata of a wake of a lambda, the `number`-th from 0.
    pub fn wake(lambda: usize, number: u64, at_ns: i64, group: u64) -> EntryMeta {
        EntryMeta {
            source: EntrySource::wakes(lambda),
            len: 0,
            at_ns,
            publish_ns: 0,
            seq: number,
            group,
            writer: [0; 16],
            options: [0; 2],
            is_big_endian: false,
            layout: 0,
        }
    }

    pub fn meta(&self) -> SampleMeta {
        SampleMeta {
            publish_ns: self.publish_ns,
            endian: if self.is_big_endian { Endian::Big } else { Endian::Little },
            options: self.options,
            layout: self.layout,
            ..SampleMeta::new(self.at_ns, Guid(self.writer), self.seq)
        }
    }
}

/// Identifies an entry until the store changes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct EntryId(u64);

/// An entry that a reader has come to. Unlike an [`EntryId`] it may be kept while the store
/// changes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct PrerollCursor {
    place: EntryId,
    /// Number of all entries before it, including dropped ones.
    number: u64,
}

impl PrerollCursor {
    /// Returns the ID of the entry, which is valid until the store changes.
    pub fn place(self) -> EntryId {
        self.place
    }
}

pub struct Preroll {
    kind: PrerollStore,
    highest: u64,
    /// Number of dropped entries: the number of the oldest one that is kept.
    gone: u64,
}

enum PrerollStore {
    Ram(Ram),
    Disk(Disk),
}

/// Does the same with either store.
macro_rules! each {
    ($kind:expr, $store:ident => $act:expr) => {
        match $kind {
            PrerollStore::Ram($store) => $act,
            PrerollStore::Disk($store) => $act,
        }
    };
}

impl Preroll {
    /// Creates an empty store of at most `bytes`. On disk it is in `folder`, where files of an
    /// earlier process are deleted. In memory, `prefault` allocates it at once.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if the folder cannot be created or emptied,
    /// [`RecordError::PrerollMemory`] if the memory cannot be allocated.
    pub fn open(
        store: Store,
        bytes: u64,
        folder: PathBuf,
        prefault: bool,
    ) -> Result<Preroll, RecordError> {
        let kind = match store {
            Store::Ram => {
                let ram = Ram::new(usize::try_from(bytes).unwrap_or(usize::MAX), prefault);
                PrerollStore::Ram(
                    ram.map_err(|source| RecordError::PrerollMemory { bytes, source })?,
                )
            }
            Store::Disk => PrerollStore::Disk(Disk::open(folder, bytes)?),
        };
        Ok(Preroll { kind, highest: 0, gone: 0 })
    }

    /// Raises the bound to `bytes`, and moves to disk if `store` is the disk. Entries are kept, but
    /// may move: `true` means that every [`PrerollCursor`] is invalid.
    ///
    /// # Errors
    ///
    /// As for [`Preroll::open`] and [`Preroll::push`].
    pub fn grow(
        &mut self,
        store: Store,
        bytes: u64,
        folder: PathBuf,
        prefault: bool,
    ) -> Result<bool, RecordError> {
        if let PrerollStore::Disk(disk) = &mut self.kind {
            disk.grow(bytes);
            return Ok(false);
        }
        let mut new = Preroll::open(store, bytes, folder, prefault)?;
        let mut next = self.next(None);
        while let Some(walked) = next {
            let held = self.held(walked.place());
            let bytes = self.bytes(walked.place())?;
            match &mut new.kind {
                PrerollStore::Ram(_) => new.push(held, bytes, &mut |_| {})?,
                // On a full disk the old store stays in use.
                PrerollStore::Disk(disk) => disk.add(&held, bytes, &mut |_| {})?,
            };
            next = self.next(next);
        }
        self.kind = new.kind;
        Ok(true)
    }

    /// Adds an entry; the oldest are dropped to make room and passed to `gone`. On a full disk the
    /// new entry itself may be. Returns `false` if it is larger than the store;
    /// [`RecordError::Preroll`] if the disk fails.
    pub fn push(
        &mut self,
        held: EntryMeta,
        bytes: &[u8],
        gone: &mut dyn FnMut(&EntryMeta),
    ) -> Result<bool, RecordError> {
        let Ok(len) = u32::try_from(bytes.len()) else { return Ok(false) };
        let held = EntryMeta { len, ..held };
        let count = &mut self.gone;
        let mut gone = |held: &EntryMeta| {
            *count += 1;
            gone(held);
        };
        let taken = match &mut self.kind {
            PrerollStore::Ram(ram) => ram.push(&held, bytes, &mut gone),
            PrerollStore::Disk(disk) => disk.push(&held, bytes, &mut gone)?,
        };
        self.highest = self.highest.max(self.bytes_held());
        Ok(taken)
    }

    /// Sets whether it shrinks as entries come, because its disk has too little room. No effect in
    /// memory.
    pub fn shrink(&mut self, shrinks: bool) {
        if let PrerollStore::Disk(disk) = &mut self.kind {
            disk.shrink(shrinks);
        }
    }

    /// Drops entries older than `before`, from the oldest on, and passes them to `aged`;
    /// [`RecordError::Preroll`] if the disk fails.
    pub fn trim(
        &mut self,
        before: i64,
        aged: &mut dyn FnMut(&EntryMeta),
    ) -> Result<(), RecordError> {
        let count = &mut self.gone;
        let mut aged = |held: &EntryMeta| {
            *count += 1;
            aged(held);
        };
        match &mut self.kind {
            PrerollStore::Ram(ram) => {
                ram.trim(before, &mut aged);
                Ok(())
            }
            PrerollStore::Disk(disk) => disk.trim(before, &mut aged),
        }
    }

    /// Returns the entry after `last`, or the oldest if `last` was dropped or is `None`.
    pub fn next(&self, last: Option<PrerollCursor>) -> Option<PrerollCursor> {
        match last {
            Some(PrerollCursor { place, number }) if number >= self.gone => {
                let next = each!(&self.kind, store => store.after(place));
                next.map(|place| PrerollCursor { place, number: number + 1 })
            }
            _ => {
                let oldest = each!(&self.kind, store => store.oldest());
                oldest.map(|place| PrerollCursor { place, number: self.gone })
            }
        }
    }

    pub fn newest(&self) -> Option<PrerollCursor> {
        let (place, entries) = each!(&self.kind, store => (store.newest()?, store.entries()));
        Some(PrerollCursor { place, number: (self.gone + entries).saturating_sub(1) })
    }

    /// Returns the ID of an entry, unless it was dropped.
    pub fn find(&self, walked: PrerollCursor) -> Option<EntryId> {
        (walked.number >= self.gone).then_some(walked.place)
    }

    /// Returns whether an entry of `len` bytes fits, once others are dropped.
    pub fn fits(&self, len: usize) -> bool {
        each!(&self.kind, store => store.fits(len))
    }

    pub fn held(&self, place: EntryId) -> EntryMeta {
        each!(&self.kind, store => store.held(place))
    }

    /// Returns the bytes of an entry; [`RecordError::Preroll`] if the disk fails.
    pub fn bytes(&mut self, place: EntryId) -> Result<&[u8], RecordError> {
        match &mut self.kind {
            PrerollStore::Ram(ram) => Ok(ram.bytes(place)),
            PrerollStore::Disk(disk) => disk.bytes(place),
        }
    }

    /// Marks an entry as written to the clips of a group of windows.
    pub fn mark(&mut self, place: EntryId, group: u64) {
        each!(&mut self.kind, store => store.mark(place, group))
    }

    /// Returns the bytes in use, including the overhead of entries.
    pub fn bytes_held(&self) -> u64 {
        each!(&self.kind, store => store.bytes_held())
    }

    pub fn bytes_highest(&self) -> u64 {
        self.highest
    }
}

#[cfg(test)]
mod tests;
