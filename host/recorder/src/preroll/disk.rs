//! A preroll on disk: chunk files that are written once and deleted as a whole, with an index in
//! memory.
//!
//! The bound covers files and index together. Room is made by the chunk, so up to a sixteenth of
//! the bound more is dropped than in memory. If the disk has less room than the bound, the oldest
//! chunks are dropped as well.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use gleaner_base::safe_file;
use tracing::warn;

use super::{EntryId, EntryMeta};
use crate::RecordError;

const INDEXED: u64 = size_of::<Indexed>() as u64;

/// Maximum number of entries in the index, so that small samples in a large store do not fill the
/// memory: 72 MiB.
const INDEX_MAX: usize = 1 << 20;

/// A chunk is a sixteenth of the store, within these bounds.
const CHUNK_MIN: u64 = 1 << 20;
const CHUNK_MAX: u64 = 64 << 20;

/// Bytes that are collected for a write.
const PENDING: usize = 256 << 10;

pub(super) struct Disk {
    folder: PathBuf,
    bound: u64,
    chunk_bytes: u64,
    chunks: VecDeque<Chunk>,
    next_chunk: u64,
    /// The file of the newest chunk, and its unwritten bytes.
    newest: Option<File>,
    pending: Vec<u8>,
    index: VecDeque<Indexed>,
    /// The number of the oldest entry in the index, counted from the first of all.
    first: u64,
    bytes: u64,
    /// The chunk that was read last, and the buffer for reads.
    reader: Option<(u64, File)>,
    buffer: Vec<u8>,
    /// True if more chunks are dropped than added, because the disk has too little room.
    shrinks: bool,
    /// True if a full disk was logged.
    was_full: bool,
}

struct Indexed {
    held: EntryMeta,
    offset: u64,
}

struct Chunk {
    number: u64,
    /// The number of its first entry.
    first: u64,
    bytes: u64,
}

impl Disk {
    pub(super) fn open(folder: PathBuf, bound: u64) -> Result<Disk, RecordError> {
        let disk = Disk {
            chunk_bytes: (bound / 16).clamp(CHUNK_MIN, CHUNK_MAX),
            folder,
            bound,
            chunks: VecDeque::new(),
            next_chunk: 0,
            newest: None,
            pending: Vec::with_capacity(PENDING),
            index: VecDeque::new(),
            first: 0,
            bytes: 0,
            reader: None,
            buffer: Vec::new(),
            shrinks: false,
            was_full: false,
        };
        safe_file::folder(&disk.folder).map_err(failed(&disk.folder))?;
        for entry in fs::read_dir(&disk.folder).map_err(failed(&disk.folder))? {
            let path = entry.map_err(failed(&disk.folder))?.path();
            if is_chunk(&path) {
                fs::remove_file(&path).map_err(failed(&path))?;
            }
        }
        Ok(disk)
    }

    /// Adds an entry. On a full disk, drops the oldest entries for it as well; if that does not
    /// help, drops the new one.
    pub(super) fn push(
        &mut self,
        held: &EntryMeta,
        bytes: &[u8],
        gone: &mut dyn FnMut(&EntryMeta),
    ) -> Result<bool, RecordError> {
        loop {
            match self.add(held, bytes, gone) {
                Err(error) if error.is_full_disk() => {
                    if !std::mem::replace(&mut self.was_full, true) {
                        let folder = self.folder.display();
                        warn!(%folder, "the disk is full: the preroll is smaller than its bound");
                    }
                    let is_alone = self.bytes == 0;
                    self.drop_oldest(gone)?;
                    if is_alone {
                        gone(held);
                        return Ok(true);
                    }
                }
                added => return added,
            }
        }
    }

    /// Adds an entry as [`push`](Self::push) does, but a full disk is an error, after which nothing
    /// has changed.
    pub(super) fn add(
        &mut self,
        held: &EntryMeta,
        bytes: &[u8],
        gone: &mut dyn FnMut(&EntryMeta),
    ) -> Result<bool, RecordError> {
        if !self.fits(bytes.len()) {
            return Ok(false);
        }
        let len = bytes.len() as u64;
        while self.bytes + len + INDEXED > self.bound || self.index.len() >= INDEX_MAX {
            self.drop_oldest(gone)?;
        }
        if self
            .chunks
            .back()
            .is_some_and(|chunk| chunk.bytes > 0 && chunk.bytes + len > self.chunk_bytes)
        {
            self.flush()?;
            self.newest = None;
        }
        if self.newest.is_none() {
            let too_many = if self.shrinks { 2 } else { 0 };
            for _ in 0..too_many {
                self.drop_oldest(gone)?;
            }
            let path = self.path(self.next_chunk);
            self.newest = Some(begin(&path).map_err(failed(&path))?);
            let first = self.first + self.index.len() as u64;
            self.chunks.push_back(Chunk { number: self.next_chunk, first, bytes: 0 });
            self.next_chunk += 1;
        }
        if self.pending.len() + bytes.len() > PENDING {
            self.flush()?;
        }
        let Some(chunk) = self.chunks.back_mut() else { return Ok(false) };
        let offset = chunk.bytes;
        if bytes.len() > PENDING {
            let path = path_of(&self.folder, chunk.number);
            let file = self.newest.as_ref().expect("the newest chunk has just been opened");
            file.write_all_at(bytes, offset).map_err(failed(&path))?;
        } else {
            self.pending.extend_from_slice(bytes);
        }
        chunk.bytes += len;
        self.index.push_back(Indexed { held: *held, offset });
        self.bytes += len + INDEXED;
        Ok(true)
    }

    fn flush(&mut self) -> Result<(), RecordError> {
        if let (Some(chunk), Some(file)) = (self.chunks.back(), &self.newest) {
            let path = path_of(&self.folder, chunk.number);
            let offset = chunk.bytes - self.pending.len() as u64;
            file.write_all_at(&self.pending, offset).map_err(failed(&path))?;
        }
        self.pending.clear();
        Ok(())
    }

    /// Deletes the oldest chunk with its remaining entries.
    fn drop_oldest(&mut self, gone: &mut dyn FnMut(&EntryMeta)) -> Result<(), RecordError> {
        let Some(chunk) = self.chunks.pop_front() else { return Ok(()) };
        let end = match self.chunks.front() {
            Some(next) => next.first,
            None => {
                self.newest = None;
                self.pending.clear();
                self.first + self.index.len() as u64
            }
        };
        while self.first < end {
            let Some(entry) = self.pop() else { break };
            gone(&entry);
        }
        self.bytes -= chunk.bytes;
        self.reader.take_if(|(number, _)| *number == chunk.number);
        let path = self.path(chunk.number);
        fs::remove_file(&path).map_err(failed(&path))
    }

    fn pop(&mut self) -> Option<EntryMeta> {
        let entry = self.index.pop_front()?;
        self.first += 1;
        self.bytes -= INDEXED;
        Some(entry.held)
    }

    pub(super) fn trim(
        &mut self,
        before: i64,
        aged: &mut dyn FnMut(&EntryMeta),
    ) -> Result<(), RecordError> {
        while self.index.front().is_some_and(|entry| entry.held.at_ns < before) {
            if let Some(held) = self.pop() {
                aged(&held);
            }
        }
        while self.chunks.get(1).is_some_and(|next| next.first <= self.first) {
            self.drop_oldest(&mut |_| {})?;
        }
        Ok(())
    }

    pub(super) fn grow(&mut self, bound: u64) {
        self.bound = bound;
        self.chunk_bytes = (bound / 16).clamp(CHUNK_MIN, CHUNK_MAX);
    }

    pub(super) fn shrink(&mut self, shrinks: bool) {
        self.shrinks = shrinks;
    }

    pub(super) fn fits(&self, len: usize) -> bool {
        len as u64 + INDEXED <= self.bound
    }

    pub(super) fn entries(&self) -> u64 {
        self.index.len() as u64
    }

    pub(super) fn newest(&self) -> Option<EntryId> {
        self.entries().checked_sub(1).map(|last| EntryId(self.first + last))
    }

    pub(super) fn oldest(&self) -> Option<EntryId> {
        (!self.index.is_empty()).then_some(EntryId(self.first))
    }

    pub(super) fn after(&self, place: EntryId) -> Option<EntryId> {
        let next = place.0 + 1;
        (next < self.first + self.index.len() as u64).then_some(EntryId(next))
    }

    pub(super) fn held(&self, place: EntryId) -> EntryMeta {
        self.entry(place).held
    }

    pub(super) fn bytes(&mut self, place: EntryId) -> Result<&[u8], RecordError> {
        let Indexed { held, offset } = *self.entry(place);
        let len = held.len as usize;
        let chunk = &self.chunks[self.chunks.partition_point(|chunk| chunk.first <= place.0) - 1];
        let written = if chunk.number + 1 == self.next_chunk && self.newest.is_some() {
            chunk.bytes - self.pending.len() as u64
        } else {
            chunk.bytes
        };
        if let Some(begin) = offset.checked_sub(written) {
            // The last entry of a chunk is not followed by another, so an empty one ends at the end
            // of the written bytes.
            return Ok(&self.pending[begin as usize..][..len]);
        }
        let (number, path) = (chunk.number, path_of(&self.folder, chunk.number));
        if self.reader.as_ref().is_none_or(|(open, _)| *open != number) {
            self.reader = Some((number, safe_file::read(&path).map_err(failed(&path))?));
        }
        self.buffer.resize(len, 0);
        if let Some((_, file)) = &self.reader {
            file.read_exact_at(&mut self.buffer, offset).map_err(failed(&path))?;
        }
        Ok(&self.buffer)
    }

    pub(super) fn mark(&mut self, place: EntryId, group: u64) {
        let index = (place.0 - self.first) as usize;
        self.index[index].held.group = group;
    }

    pub(super) fn bytes_held(&self) -> u64 {
        self.bytes
    }

    fn entry(&self, place: EntryId) -> &Indexed {
        &self.index[(place.0 - self.first) as usize]
    }

    fn path(&self, number: u64) -> PathBuf {
        path_of(&self.folder, number)
    }
}

impl Drop for Disk {
    /// Deletes the preroll: it is of no use to a later process, which would delete it.
    fn drop(&mut self) {
        for chunk in &self.chunks {
            let _ = fs::remove_file(self.path(chunk.number));
        }
        // The folder stays if it has other files.
        let _ = fs::remove_dir(&self.folder);
    }
}

fn begin(path: &Path) -> io::Result<File> {
    // A test uses links to a full disk.
    #[cfg(test)]
    if fs::read_link(path).is_ok_and(|full| full == Path::new("/dev/full")) {
        return File::create(path);
    }
    safe_file::create(path)
}

fn path_of(folder: &Path, number: u64) -> PathBuf {
    folder.join(format!("{number}.chunk"))
}

fn is_chunk(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str());
    let number = name.and_then(|name| name.strip_suffix(".chunk"));
    number.is_some_and(|number| {
        !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit())
    })
}

fn failed(path: &Path) -> impl FnOnce(io::Error) -> RecordError {
    let path = path.to_owned();
    |source| RecordError::Preroll { path, source }
}
