//! A disk in memory whose operations fail on request, and that loses what was not synced.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io;
use std::ops::Range;
use std::rc::Rc;

use gleaner_spool::{SegmentFile, SpoolNote, SpoolStorage};

/// Pseudo-random numbers, the same in each run (SplitMix64).
#[derive(Default)]
pub struct SpoolRandom(pub u64);

impl SpoolRandom {
    pub fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % n
    }
}

/// The operations that fail.
#[derive(Clone, Copy, Debug)]
pub struct DiskFault {
    /// The first one, from 1.
    pub from: u64,
    /// Their number.
    pub count: u64,
    /// `StorageFull` lets only operations fail that need space.
    pub kind: io::ErrorKind,
}

/// Pieces of a write, each of which a power cut keeps or loses.
const SECTOR: usize = 512;

#[derive(Default)]
struct Inode {
    content: Vec<u8>,
    durable: Vec<u8>,
    /// Ranges of `content` that the next sync makes durable.
    unsynced: Vec<(usize, usize)>,
}

#[derive(Default)]
struct Disk {
    inodes: Vec<Inode>,
    names: BTreeMap<u64, usize>,
    /// The file that was created and not published.
    created: Option<usize>,
    durable_names: BTreeMap<u64, usize>,
    random: SpoolRandom,
    operations: u64,
    lists: u64,
    released: u64,
    note: Option<SpoolNote>,
    fault: Option<DiskFault>,
    /// Segment, and range of its bytes, whose reads fail with `EIO`.
    unreadable: Option<(u64, Range<u64>)>,
}

#[derive(Clone)]
pub struct SimulatedDisk(Rc<RefCell<Disk>>);

impl std::fmt::Debug for SimulatedDisk {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.firsts()).finish()
    }
}

#[derive(Debug)]
pub struct SimulatedFile {
    disk: SimulatedDisk,
    inode: usize,
}

impl SimulatedDisk {
    pub fn new(seed: u64) -> SimulatedDisk {
        SimulatedDisk(Rc::new(RefCell::new(Disk { random: SpoolRandom(seed), ..Disk::default() })))
    }

    pub fn set_fault(&self, fault: Option<DiskFault>) {
        self.0.borrow_mut().fault = fault;
    }

    /// Lets reads fail that begin in `range` of segment `first`. Others end before it.
    pub fn set_unreadable(&self, first: u64, range: Range<u64>) {
        self.0.borrow_mut().unreadable = Some((first, range));
    }

    pub fn operations(&self) -> u64 {
        self.0.borrow().operations
    }

    /// Number of times that the names were listed.
    pub fn lists(&self) -> u64 {
        self.0.borrow().lists
    }

    /// Content of the segment `first`, for changes.
    pub fn with_content<R>(&self, first: u64, change: impl FnOnce(&mut Vec<u8>) -> R) -> R {
        let disk = &mut *self.0.borrow_mut();
        change(&mut disk.inodes[disk.names[&first]].content)
    }

    /// Adds an empty segment, in place of any of its name.
    pub fn add(&self, first: u64) -> SimulatedFile {
        let file = self.create().unwrap();
        self.publish(first).unwrap();
        file
    }

    pub fn firsts(&self) -> Vec<u64> {
        self.0.borrow().names.keys().copied().collect()
    }

    /// Loses any part of what was not synced: sectors of writes, in any order, and names.
    pub fn power_cut(&self) {
        let disk = &mut *self.0.borrow_mut();
        let mut names = disk.durable_names.clone();
        for (first, inode) in &disk.names {
            if disk.random.below(2) == 0 {
                names.insert(*first, *inode);
            }
        }
        names.retain(|first, _| disk.names.contains_key(first) || disk.random.below(2) == 0);
        for inode in &mut disk.inodes {
            let mut content = inode.durable.clone();
            for (from, to) in inode.unsynced.drain(..) {
                for at in (from..to).step_by(SECTOR) {
                    if disk.random.below(3) == 0 {
                        continue;
                    }
                    // A sector that was being written may be incomplete, too.
                    let whole = to.min(at + SECTOR);
                    let part = disk.random.below((whole - at) as u64) as usize;
                    let end = if disk.random.below(8) == 0 { at + part } else { whole };
                    content.resize(content.len().max(end), 0);
                    content[at..end].copy_from_slice(&inode.content[at..end]);
                }
            }
            inode.content = content;
            inode.durable = inode.content.clone();
        }
        (disk.durable_names, disk.names, disk.created) = (names.clone(), names, None);
        if disk.random.below(2) == 0 {
            disk.note = None;
        }
    }

    /// Counts an operation, and fails if it is its turn.
    fn operation(&self, needs_space: bool) -> io::Result<()> {
        let disk = &mut *self.0.borrow_mut();
        disk.operations += 1;
        match disk.fault {
            Some(fault)
                if (needs_space || fault.kind != io::ErrorKind::StorageFull)
                    && disk.operations >= fault.from
                    && disk.operations - fault.from < fault.count =>
            {
                Err(fault.kind.into())
            }
            _ => Ok(()),
        }
    }
}

impl SpoolStorage for SimulatedDisk {
    type File = SimulatedFile;

    fn list(&self) -> io::Result<Vec<(u64, u64)>> {
        self.operation(false)?;
        self.0.borrow_mut().lists += 1;
        let disk = self.0.borrow();
        let length = |inode: &usize| disk.inodes[*inode].content.len() as u64;
        Ok(disk.names.iter().map(|(first, inode)| (*first, length(inode))).collect())
    }

    /// An empty file needs no space on most file systems.
    fn create(&self) -> io::Result<SimulatedFile> {
        self.operation(false)?;
        let disk = &mut *self.0.borrow_mut();
        disk.inodes.push(Inode::default());
        let inode = disk.inodes.len() - 1;
        disk.created = Some(inode);
        Ok(SimulatedFile { disk: self.clone(), inode })
    }

    fn publish(&self, first: u64) -> io::Result<()> {
        self.operation(true)?;
        let disk = &mut *self.0.borrow_mut();
        let inode = disk.created.take().ok_or(io::ErrorKind::NotFound)?;
        disk.names.insert(first, inode);
        Ok(())
    }

    fn open(&self, first: u64) -> io::Result<SimulatedFile> {
        self.operation(false)?;
        let inode = self.0.borrow().names.get(&first).copied();
        let inode = inode.ok_or(io::ErrorKind::NotFound)?;
        Ok(SimulatedFile { disk: self.clone(), inode })
    }

    fn remove(&self, first: u64) -> io::Result<()> {
        self.operation(false)?;
        let removed = self.0.borrow_mut().names.remove(&first);
        removed.map(|_| ()).ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    fn sync_names(&self) -> io::Result<()> {
        self.operation(false)?;
        let disk = &mut *self.0.borrow_mut();
        disk.durable_names = disk.names.clone();
        Ok(())
    }

    fn released(&self) -> io::Result<u64> {
        self.operation(false)?;
        Ok(self.0.borrow().released)
    }

    fn release(&self, before: u64) -> io::Result<()> {
        self.operation(false)?;
        self.0.borrow_mut().released = before;
        Ok(())
    }

    fn noted(&self) -> io::Result<Option<SpoolNote>> {
        self.operation(false)?;
        Ok(self.0.borrow().note)
    }

    /// In place: it needs no space.
    fn note(&self, note: &SpoolNote) -> io::Result<()> {
        self.operation(false)?;
        self.0.borrow_mut().note = Some(*note);
        Ok(())
    }
}

impl SegmentFile for SimulatedFile {
    fn length(&self) -> io::Result<u64> {
        self.disk.operation(false)?;
        Ok(self.disk.0.borrow().inodes[self.inode].content.len() as u64)
    }

    fn is_linked(&self) -> io::Result<bool> {
        self.disk.operation(false)?;
        let disk = self.disk.0.borrow();
        Ok(disk.names.values().chain(&disk.created).any(|inode| *inode == self.inode))
    }

    fn read_at(&self, into: &mut [u8], offset: u64) -> io::Result<usize> {
        self.disk.operation(false)?;
        let disk = self.disk.0.borrow();
        let content = &disk.inodes[self.inode].content;
        let mut end = content.len();
        if let Some((first, range)) = &disk.unreadable
            && disk.names.get(first) == Some(&self.inode)
        {
            if range.contains(&offset) {
                return Err(io::Error::from_raw_os_error(rustix::io::Errno::IO.raw_os_error()));
            }
            if offset < range.start {
                end = end.min(range.start as usize);
            }
        }
        let content = &content[..end];
        let rest = content.get(offset as usize..).unwrap_or_default();
        let read = rest.len().min(into.len());
        into[..read].copy_from_slice(&rest[..read]);
        Ok(read)
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        let allowed = self.disk.operation(true);
        let disk = &mut *self.disk.0.borrow_mut();
        // A write that fails may have written a part.
        let written = match allowed {
            Ok(()) => bytes.len(),
            Err(_) => disk.random.below(bytes.len() as u64 + 1) as usize,
        };
        let inode = &mut disk.inodes[self.inode];
        let from = inode.content.len();
        inode.content.extend_from_slice(&bytes[..written]);
        inode.unsynced.push((from, from + written));
        allowed
    }

    fn sync(&self) -> io::Result<()> {
        let allowed = self.disk.operation(false);
        let disk = &mut *self.disk.0.borrow_mut();
        let inode = &mut disk.inodes[self.inode];
        for (from, to) in std::mem::take(&mut inode.unsynced) {
            // As Linux does: what could not be written counts as written from then on, so a later
            // sync succeeds without it, although readers still see it.
            if allowed.is_ok() || disk.random.below(2) == 0 {
                inode.durable.resize(inode.durable.len().max(to), 0);
                inode.durable[from..to].copy_from_slice(&inode.content[from..to]);
            }
        }
        allowed
    }
}
