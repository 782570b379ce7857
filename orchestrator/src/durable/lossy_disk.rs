//! A disk in memory on which one operation fails, all later ones do, or the power is cut: what was
//! not synced is then lost, in part or not at all.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::WriteSteps;
use rustix::io::Errno;

#[derive(Clone, Copy, Debug)]
pub(super) enum StepFault {
    /// It fails once, with this error.
    Once(Errno),
    /// It fails with this error, and so do all later ones.
    Always(Errno),
    /// It is the last one before the machine loses power.
    PowerCut,
}

pub(super) type DiskImage = BTreeMap<PathBuf, Vec<u8>>;

#[derive(Default)]
struct Inode {
    content: Vec<u8>,
    is_durable: bool,
}

#[derive(Default)]
struct LossyState {
    inodes: Vec<Inode>,
    names: BTreeMap<PathBuf, usize>,
    durable: BTreeMap<PathBuf, usize>,
    /// Changes of names since the folder was synced. Each may be on the disk or not.
    pending: Vec<Vec<(PathBuf, Option<usize>)>>,
    operations: usize,
}

pub(super) struct LossyDisk {
    disk: RefCell<LossyState>,
    /// Number of the operation, from 0.
    at: usize,
    fault: StepFault,
}

impl LossyDisk {
    pub(super) fn new(at: usize, fault: StepFault) -> Self {
        Self { disk: RefCell::default(), at, fault }
    }

    pub(super) fn operations(&self) -> usize {
        self.disk.borrow().operations
    }

    /// Returns what other programs read now.
    pub(super) fn visible(&self) -> DiskImage {
        let disk = self.disk.borrow();
        let content =
            |(path, inode): (&PathBuf, &usize)| (path.clone(), disk.inodes[*inode].content.clone());
        disk.names.iter().map(content).collect()
    }

    /// Returns all that may be left after a power cut: any of the pending names; and of content
    /// that was not synced nothing, a half, or all.
    pub(super) fn after_power_cut(&self) -> BTreeSet<DiskImage> {
        let disk = self.disk.borrow();
        let mut images = BTreeSet::new();
        for chosen in 0..1_usize << disk.pending.len() {
            let mut names = disk.durable.clone();
            for (index, change) in disk.pending.iter().enumerate() {
                if chosen & (1 << index) != 0 {
                    change.iter().for_each(|(path, inode)| set(&mut names, path, *inode));
                }
            }
            for kept in 0..3 {
                let content = |(path, inode): (&PathBuf, &usize)| {
                    let Inode { content, is_durable } = &disk.inodes[*inode];
                    let length = if *is_durable { content.len() } else { content.len() * kept / 2 };
                    (path.clone(), content[..length].to_vec())
                };
                images.insert(names.iter().map(content).collect());
            }
        }
        images
    }

    /// Counts an operation, which fails if it is its turn.
    fn step(&self) -> io::Result<()> {
        let number = self.disk.borrow().operations;
        self.disk.borrow_mut().operations += 1;
        match self.fault {
            StepFault::Once(error) if number == self.at => Err(error.into()),
            StepFault::Always(error) if number >= self.at => Err(error.into()),
            StepFault::PowerCut if number > self.at => Err(Errno::IO.into()),
            _ => Ok(()),
        }
    }

    fn rename_all(&self, change: Vec<(PathBuf, Option<usize>)>) {
        let disk = &mut *self.disk.borrow_mut();
        change.iter().for_each(|(path, inode)| set(&mut disk.names, path, *inode));
        disk.pending.push(change);
    }
}

fn set(names: &mut BTreeMap<PathBuf, usize>, path: &Path, inode: Option<usize>) {
    match inode {
        Some(inode) => names.insert(path.to_owned(), inode),
        None => names.remove(path),
    };
}

impl WriteSteps for LossyDisk {
    type File = usize;

    fn create(&self, path: &Path) -> io::Result<usize> {
        if self.disk.borrow().names.contains_key(path) {
            self.remove(path)?;
        }
        self.step()?;
        self.disk.borrow_mut().inodes.push(Inode::default());
        let inode = self.disk.borrow().inodes.len() - 1;
        self.rename_all(vec![(path.to_owned(), Some(inode))]);
        Ok(inode)
    }

    fn write(&self, file: &mut usize, bytes: &[u8]) -> io::Result<()> {
        let allowed = self.step();
        // A write that fails may have written a part.
        let length = if allowed.is_ok() { bytes.len() } else { bytes.len() / 2 };
        self.disk.borrow_mut().inodes[*file].content.extend_from_slice(&bytes[..length]);
        allowed
    }

    fn sync(&self, file: &usize) -> io::Result<()> {
        self.step()?;
        self.disk.borrow_mut().inodes[*file].is_durable = true;
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.step()?;
        let inode = self.disk.borrow().names.get(from).copied().ok_or(io::ErrorKind::NotFound)?;
        self.rename_all(vec![(from.to_owned(), None), (to.to_owned(), Some(inode))]);
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.step()?;
        self.rename_all(vec![(path.to_owned(), None)]);
        Ok(())
    }

    fn sync_folder(&self, _: &Path) -> io::Result<()> {
        self.step()?;
        let disk = &mut *self.disk.borrow_mut();
        disk.durable = disk.names.clone();
        disk.pending.clear();
        Ok(())
    }
}
