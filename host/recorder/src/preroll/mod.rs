//! What came lately, in order of arrival, within a bound of bytes and of time: where clips begin
//! before their trigger.
//!
//! One store for everything. It knows nothing of windows; who reads it walks from the oldest to the
//! newest and marks what was written to a clip, so that nothing is written to it twice.

mod disk;
mod losses;
mod ram;

use std::path::PathBuf;

use gleaner_lambda::manifest::Store;
use gleaner_messages::Endian;
use gleaner_transport::{Guid, SampleMeta};

pub use losses::Losses;

use crate::RecordError;
use disk::Disk;
use ram::Ram;

/// What every entry costs beside its bytes.
pub const OVERHEAD: usize = 64;

/// Where an entry comes from: a topic, or the wakes of a lambda.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct EntrySource(u32);

/// The bit that tells wakes from topics.
const WAKES: u32 = 1 << 31;

impl EntrySource {
    /// A topic, by its number.
    pub fn topic(index: usize) -> EntrySource {
        // Topics and lambdas are counted in hundreds.
        EntrySource(u32::try_from(index).unwrap_or(WAKES - 1) & !WAKES)
    }

    /// The wakes of a lambda, by its number.
    pub fn wakes(lambda: usize) -> EntrySource {
        EntrySource(EntrySource::topic(lambda).0 | WAKES)
    }

    /// The number of the lambda, if these are wakes.
    pub fn lambda(self) -> Option<usize> {
        (self.0 & WAKES != 0).then_some((self.0 & !WAKES) as usize)
    }

    /// The number of the topic, if it is one.
    pub fn as_topic(self) -> Option<usize> {
        (self.0 & WAKES == 0).then_some(self.0 as usize)
    }
}

/// What is known of an entry besides its bytes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct EntryMeta {
    /// Where it comes from.
    pub source: EntrySource,
    /// Length of its bytes.
    pub len: u32,
    /// The stamp that windows go by.
    pub at_ns: i64,
    /// When the writer published it; for a wake 0.
    pub publish_ns: i64,
    /// Sequence number, or the number of the wake.
    pub seq: u64,
    /// The group of windows in whose clips it is, 0 for none.
    pub group: u64,
    /// Who wrote it; for a wake zeros.
    pub writer: [u8; 16],
    /// Options of the encapsulation.
    pub options: [u8; 2],
    /// Byte order.
    pub is_big_endian: bool,
}

impl EntryMeta {
    /// A sample of a topic.
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
        }
    }

    /// A wake of a lambda, the `number`-th from 0.
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
        }
    }

    /// As the transport said it.
    pub fn meta(&self) -> SampleMeta {
        SampleMeta {
            at_ns: self.at_ns,
            publish_ns: self.publish_ns,
            writer: Guid(self.writer),
            seq: self.seq,
            endian: if self.is_big_endian { Endian::Big } else { Endian::Little },
            options: self.options,
        }
    }
}

/// Names an entry until the store changes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct EntryId(u64);

/// An entry that a walk from the oldest on has come to. Unlike a [`EntryId`] it may be kept while the
/// store changes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Walked {
    place: EntryId,
    /// How many entries ever came before it.
    number: u64,
}

impl Walked {
    /// Where it is, until the store changes.
    pub fn place(self) -> EntryId {
        self.place
    }
}

/// The store.
pub struct Preroll {
    kind: PrerollStore,
    highest: u64,
    /// Entries that have gone: the number of the oldest one that is held.
    gone: u64,
}

enum PrerollStore {
    Ram(Ram),
    Disk(Disk),
}

impl Preroll {
    /// An empty store of at most `bytes`. On disk it is in `folder`, where what an earlier process
    /// left is deleted. In memory, `prefault` takes it from the system at once.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if the folder cannot be made or emptied,
    /// [`RecordError::PrerollMemory`] if the system does not have as much memory.
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

    /// Lets it hold `bytes`, on disk if `store` is that. What it holds stays, but may lie
    /// elsewhere: `true` says that no [`Walked`] is of use any more.
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
                // On a full disk it stays where it is.
                PrerollStore::Disk(disk) => disk.add(&held, bytes, &mut |_| {})?,
            };
            next = self.next(next);
        }
        self.kind = new.kind;
        Ok(true)
    }

    /// Adds an entry; the oldest go to make room for it, and are told to `gone`: on a full disk it
    /// may be told itself. `false` if it is larger than the store.
    ///
    /// # Errors
    ///
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

    /// Whether it gets smaller with what comes, as its disk has too little room. In memory that
    /// changes nothing.
    pub fn shrink(&mut self, shrinks: bool) {
        if let PrerollStore::Disk(disk) = &mut self.kind {
            disk.shrink(shrinks);
        }
    }

    /// Gives up what is older than `before`, from the oldest on, and tells it to `aged`.
    ///
    /// # Errors
    ///
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

    /// The entry that came after `last`, or the oldest if `last` has gone or is none.
    pub fn next(&self, last: Option<Walked>) -> Option<Walked> {
        match last {
            Some(Walked { place, number }) if number >= self.gone => {
                self.after(place).map(|place| Walked { place, number: number + 1 })
            }
            _ => self.oldest().map(|place| Walked { place, number: self.gone }),
        }
    }

    /// The entry that came last.
    pub fn newest(&self) -> Option<Walked> {
        let (place, entries) = match &self.kind {
            PrerollStore::Ram(ram) => (ram.newest()?, ram.entries()),
            PrerollStore::Disk(disk) => (disk.newest()?, disk.entries()),
        };
        Some(Walked { place, number: (self.gone + entries).saturating_sub(1) })
    }

    /// Where an entry is, unless it has gone.
    pub fn find(&self, walked: Walked) -> Option<EntryId> {
        (walked.number >= self.gone).then_some(walked.place)
    }

    /// Whether an entry of `len` bytes has room here, once others have gone for it.
    pub fn fits(&self, len: usize) -> bool {
        match &self.kind {
            PrerollStore::Ram(ram) => ram.fits(len),
            PrerollStore::Disk(disk) => disk.fits(len),
        }
    }

    /// The oldest entry.
    fn oldest(&self) -> Option<EntryId> {
        match &self.kind {
            PrerollStore::Ram(ram) => ram.oldest(),
            PrerollStore::Disk(disk) => disk.oldest(),
        }
    }

    /// The entry that came after this one.
    fn after(&self, place: EntryId) -> Option<EntryId> {
        match &self.kind {
            PrerollStore::Ram(ram) => ram.after(place),
            PrerollStore::Disk(disk) => disk.after(place),
        }
    }

    /// What is known of an entry.
    pub fn held(&self, place: EntryId) -> EntryMeta {
        match &self.kind {
            PrerollStore::Ram(ram) => ram.held(place),
            PrerollStore::Disk(disk) => disk.held(place),
        }
    }

    /// The bytes of an entry.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if the disk fails.
    pub fn bytes(&mut self, place: EntryId) -> Result<&[u8], RecordError> {
        match &mut self.kind {
            PrerollStore::Ram(ram) => Ok(ram.bytes(place)),
            PrerollStore::Disk(disk) => disk.bytes(place),
        }
    }

    /// Remembers that an entry is in the clips of a group of windows.
    pub fn mark(&mut self, place: EntryId, group: u64) {
        match &mut self.kind {
            PrerollStore::Ram(ram) => ram.mark(place, group),
            PrerollStore::Disk(disk) => disk.mark(place, group),
        }
    }

    /// Bytes held now, the overhead of entries included.
    pub fn bytes_held(&self) -> u64 {
        match &self.kind {
            PrerollStore::Ram(ram) => ram.bytes_held(),
            PrerollStore::Disk(disk) => disk.bytes_held(),
        }
    }

    /// The most bytes held so far.
    pub fn bytes_highest(&self) -> u64 {
        self.highest
    }
}

#[cfg(test)]
mod tests;
