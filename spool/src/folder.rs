//! The folder of a stream on a real disk: locked by its writer, plain files only.

use std::ffi::CStr;
use std::fs::{self, DirBuilder, File};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use gleaner_base::safe_file::UnsafePath;
use gleaner_base::sync_folder;
use rustix::fs::{
    AtFlags, Dir, FileType, FlockOperation, Mode, OFlags, Stat, fchmod, flock, fstat, openat,
    renameat, statat, unlinkat,
};
use rustix::io::Errno;

use crate::format::{SEQ_END, segment_name, u64_at, without_crc};
use crate::note::NOTE_LEN;
use crate::{SegmentFile, SpoolError, SpoolNote, SpoolStorage};

/// Name of the file that a writer locks.
const LOCK: &str = "writer.lock";

/// Name of the file with the first number that the consumer may still need, and its checksum.
const RELEASED: &str = "released";

/// Name of the file with the last note of the writer.
const NOTE: &str = "note";

/// Name of a segment before its first records are durable.
const UNPUBLISHED: &str = "next";

/// Permissions of the files in the folder.
const MODE: Mode = Mode::RUSR.union(Mode::WUSR);

/// The folder of a stream. Its writer holds a lock in it until it is dropped.
///
/// All files are opened relative to the folder that was opened at first, also if it is renamed or
/// another folder takes its place.
#[derive(Debug)]
pub struct SpoolFolder {
    /// For messages only.
    path: PathBuf,
    folder: File,
    owner: u32,
    /// The locked file; `None` for a reader.
    lock: Option<File>,
    /// The file of the note; `None` for a reader, and if a writer could not open it.
    note: Option<File>,
}

impl SpoolFolder {
    /// Opens the folder `path` for a reader.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Folder`] if it does not exist, or is not a folder.
    pub fn readable(path: &Path) -> Result<SpoolFolder, SpoolError> {
        // A slash at the end would lead through a link.
        let path = path.components().as_path().to_owned();
        let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::NONBLOCK;
        let mut options = File::options();
        options.read(true).custom_flags(flags.bits().cast_signed());
        let opened = options.open(&path).and_then(|folder| Ok((folder.metadata()?.uid(), folder)));
        match opened {
            Ok((owner, folder)) => Ok(SpoolFolder { path, folder, owner, lock: None, note: None }),
            Err(source) => Err(SpoolError::Folder { path, source }),
        }
    }

    /// Creates the folder `path` if it does not exist, for its user only, and locks it for a
    /// writer.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Busy`] if another writer has it; [`SpoolError::Folder`] if it is a link,
    /// belongs to another user, or cannot be made durable.
    pub fn locked(path: &Path) -> Result<SpoolFolder, SpoolError> {
        let path = path.components().as_path();
        let failed = |source| SpoolError::Folder { path: path.to_owned(), source };
        create_folder(path, &sync_folder).map_err(failed)?;
        let mut folder = SpoolFolder::readable(path)?;
        if folder.owner != rustix::process::geteuid().as_raw() {
            return Err(failed(foreign(folder.owner)));
        }
        // Any user that may read the folder could lock the folder itself, and keep the writer out.
        let lock = folder.open_file(LOCK, OFlags::RDWR | OFlags::CREATE).map_err(failed)?;
        fchmod(&lock, MODE).map_err(|error| failed(error.into()))?;
        match flock(&lock, FlockOperation::NonBlockingLockExclusive) {
            Err(Errno::WOULDBLOCK) => {
                let pid = lock.metadata().ok().and_then(|found| holder(found.ino()));
                return Err(SpoolError::Busy { path: path.to_owned(), pid });
            }
            other => other.map_err(|error| failed(error.into()))?,
        }
        folder.lock = Some(lock);
        folder.note = folder.open_file(NOTE, OFlags::WRONLY | OFlags::CREATE).ok();
        Ok(folder)
    }

    /// Opens the file `name`, which must be plain. Neither a link is followed, nor does a pipe
    /// block.
    fn open_file(&self, name: &str, flags: OFlags) -> io::Result<File> {
        let never = OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
        let opened =
            openat(&self.folder, name, flags | never, MODE).map_err(|error| match error {
                Errno::LOOP => self.refusal(name, &UnsafePath::Link),
                Errno::NXIO | Errno::ISDIR => self.refusal(name, &UnsafePath::NoFile),
                other => other.into(),
            })?;
        let file = File::from(opened);
        self.must_be_plain(name, &fstat(&file)?)?;
        Ok(file)
    }

    /// Refuses what is not a plain file of the folder's owner with one name.
    fn must_be_plain(&self, name: &str, found: &Stat) -> io::Result<()> {
        match FileType::from_raw_mode(found.st_mode) {
            FileType::Symlink => Err(self.refusal(name, &UnsafePath::Link)),
            FileType::RegularFile if found.st_nlink > 1 => {
                Err(self.refusal(name, &UnsafePath::HardLink))
            }
            FileType::RegularFile if found.st_uid != self.owner => {
                Err(self.refusal(name, &foreign(found.st_uid)))
            }
            FileType::RegularFile => Ok(()),
            _ => Err(self.refusal(name, &UnsafePath::NoFile)),
        }
    }

    fn refusal(&self, name: &str, why: &dyn std::error::Error) -> io::Error {
        io::Error::other(format!("`{}` cannot be used: {why}", self.path.join(name).display()))
    }

    /// Calls `found` with the name of each segment and its first number.
    fn each_segment(&self, mut found: impl FnMut(&CStr, u64) -> io::Result<()>) -> io::Result<()> {
        for entry in Dir::read_from(&self.folder)? {
            let entry = entry?;
            if let Some(first) = entry.file_name().to_str().ok().and_then(first_of) {
                found(entry.file_name(), first)?;
            }
        }
        Ok(())
    }
}

/// Creates the folder `path` for its user only, and its parents. Parents may be links. The parent
/// of `path`, and of each folder that is created, is made durable with `sync`: otherwise a power
/// cut could take the folder with all that is in it.
fn create_folder(path: &Path, sync: &dyn Fn(&Path) -> io::Result<()>) -> io::Result<()> {
    let existed = !created(path, 0o700, sync)?;
    let found = fs::symlink_metadata(path)?.file_type();
    match (found.is_dir(), found.is_symlink()) {
        // The process that created it may have ended before it synced the parent.
        (true, _) if existed => sync(parent_of(path)),
        (true, _) => Ok(()),
        (_, true) => Err(io::Error::other(UnsafePath::Link)),
        _ => Err(io::Error::other(UnsafePath::NoFolder)),
    }
}

/// Creates the folder `path` and its parents; returns whether it did not exist.
fn created(path: &Path, mode: u32, sync: &dyn Fn(&Path) -> io::Result<()>) -> io::Result<bool> {
    let create = || DirBuilder::new().mode(mode).create(path);
    let mut result = create();
    if result.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::NotFound)
        && path.parent().is_some()
    {
        created(parent_of(path), 0o777, sync)?;
        result = create();
    }
    match result {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return Ok(false),
        other => other?,
    }
    sync(parent_of(path))?;
    Ok(true)
}

fn parent_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn foreign(uid: u32) -> io::Error {
    io::Error::new(io::ErrorKind::PermissionDenied, format!("it belongs to user {uid}"))
}

/// Returns the process that holds the only lock on `inode`, if the kernel lists it.
fn holder(inode: u64) -> Option<u32> {
    // 1: FLOCK  ADVISORY  WRITE 4711 fd:01:1835 0 EOF
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let mut holders = locks.lines().filter_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let of_inode = words.get(5)?.rsplit(':').next()?.parse() == Ok(inode);
        (words[1] == "FLOCK" && of_inode).then(|| words[4].parse().ok())?
    });
    holders.next().filter(|pid| *pid != 0 && holders.next().is_none())
}

/// The first sequence number in the name of a segment.
fn first_of(name: &str) -> Option<u64> {
    let digits = name.strip_suffix(".seg")?;
    let all_digits = digits.len() == 20 && digits.bytes().all(|digit| digit.is_ascii_digit());
    digits.parse().ok().filter(|first| all_digits && *first < SEQ_END)
}

impl SpoolStorage for SpoolFolder {
    type File = File;

    fn list(&self) -> io::Result<Vec<(u64, u64)>> {
        let mut listed = Vec::new();
        self.each_segment(|name, first| {
            match statat(&self.folder, name, AtFlags::SYMLINK_NOFOLLOW) {
                // Removed meanwhile.
                Err(Errno::NOENT) => {}
                found => {
                    let found = found?;
                    self.must_be_plain(&segment_name(first), &found)?;
                    listed.push((first, u64::try_from(found.st_size).unwrap_or(0)));
                }
            }
            Ok(())
        })?;
        listed.sort_unstable();
        Ok(listed)
    }

    fn names(&self) -> io::Result<Vec<u64>> {
        let mut names = Vec::new();
        self.each_segment(|_, first| {
            names.push(first);
            Ok(())
        })?;
        names.sort_unstable();
        Ok(names)
    }

    fn create(&self) -> io::Result<File> {
        let Some(lock) = &self.lock else {
            let why = "the folder was opened for reading";
            return Err(io::Error::new(io::ErrorKind::PermissionDenied, why));
        };
        if !lock.is_linked()? {
            // Another writer may have the stream.
            return Err(io::Error::new(io::ErrorKind::NotFound, format!("`{LOCK}` was removed")));
        }
        match unlinkat(&self.folder, UNPUBLISHED, AtFlags::empty()) {
            Err(error) if error != Errno::NOENT => return Err(error.into()),
            _ => {}
        }
        self.open_file(UNPUBLISHED, OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL)
    }

    fn publish(&self, first: u64) -> io::Result<()> {
        Ok(renameat(&self.folder, UNPUBLISHED, &self.folder, segment_name(first))?)
    }

    fn open(&self, first: u64) -> io::Result<File> {
        self.open_file(&segment_name(first), OFlags::RDONLY)
    }

    fn remove(&self, first: u64) -> io::Result<()> {
        Ok(unlinkat(&self.folder, segment_name(first), AtFlags::empty())?)
    }

    fn sync_names(&self) -> io::Result<()> {
        self.folder.sync_all()
    }

    fn released(&self) -> io::Result<u64> {
        let file = match self.open_file(RELEASED, OFlags::RDONLY) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(0),
            opened => opened?,
        };
        let mut bytes = [0; 12];
        // Nothing was released if a power cut took a part.
        let is_read = file.read_exact_at(&mut bytes, 0).is_ok();
        Ok(without_crc(&bytes).filter(|_| is_read).map_or(0, |number| u64_at(number, 0)))
    }

    fn release(&self, before: u64) -> io::Result<()> {
        let number = before.to_le_bytes();
        let bytes = [&number[..], &crc32fast::hash(&number).to_le_bytes()].concat();
        self.open_file(RELEASED, OFlags::WRONLY | OFlags::CREATE)?.write_all_at(&bytes, 0)
    }

    fn noted(&self) -> io::Result<Option<SpoolNote>> {
        let file = match self.open_file(NOTE, OFlags::RDONLY) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            opened => opened?,
        };
        let mut bytes = [0; NOTE_LEN];
        let mut read =
            || FileExt::read_at(&file, &mut bytes, 0).ok().and_then(|_| SpoolNote::parse(&bytes));
        // Its writer may have been about to replace it.
        Ok(read().or_else(read))
    }

    fn note(&self, note: &SpoolNote) -> io::Result<()> {
        // Each refused record is noted, so the file stays open. One that was removed is replaced.
        if let Some(file) = self.note.as_ref().filter(|file| file.is_linked().unwrap_or(false)) {
            return file.write_all_at(&note.to_bytes(), 0);
        }
        let file = self.open_file(NOTE, OFlags::WRONLY | OFlags::CREATE)?;
        file.write_all_at(&note.to_bytes(), 0)
    }
}

impl SegmentFile for File {
    fn length(&self) -> io::Result<u64> {
        Ok(self.metadata()?.len())
    }

    fn is_linked(&self) -> io::Result<bool> {
        Ok(self.metadata()?.nlink() > 0)
    }

    fn read_at(&self, into: &mut [u8], offset: u64) -> io::Result<usize> {
        FileExt::read_at(self, into, offset)
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.write_all(bytes)
    }

    fn sync(&self) -> io::Result<()> {
        self.sync_data()
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use super::*;

    #[test]
    fn the_parent_of_each_created_folder_is_made_durable_behind_its_own() {
        let scratch = tempfile::tempdir().unwrap();
        let synced = RefCell::new(Vec::new());
        let sync = |path: &Path| {
            synced.borrow_mut().push(path.to_owned());
            sync_folder(path)
        };
        let root = scratch.path();
        create_folder(&root.join("a/b/c"), &sync).unwrap();
        assert_eq!(synced.take(), [root.to_owned(), root.join("a"), root.join("a/b")]);
        create_folder(&root.join("a/b/c"), &sync).unwrap();
        assert_eq!(synced.take(), [root.join("a/b")]);
    }
}
