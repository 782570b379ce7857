//! The folder of a stream on a real disk: locked by its writer, plain files only.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use gleaner_base::safe_file::{self, UnsafePath};
use rustix::fs::{FlockOperation, OFlags, flock};

use crate::format::segment_name;
use crate::{SegmentFile, SpoolError, SpoolStorage};

/// The folder of a stream. Its writer holds a lock on it until it is dropped.
#[derive(Debug)]
pub struct SpoolFolder {
    path: PathBuf,
    folder: File,
    owner: u32,
}

impl SpoolFolder {
    /// Opens the folder `path` for a reader.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Folder`] if it does not exist, or is not a folder.
    pub fn readable(path: &Path) -> Result<SpoolFolder, SpoolError> {
        let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::NONBLOCK;
        let mut options = File::options();
        options.read(true).custom_flags(flags.bits().cast_signed());
        let opened = options.open(path).and_then(|folder| {
            let owner = folder.metadata()?.uid();
            Ok(SpoolFolder { path: path.to_owned(), folder, owner })
        });
        opened.map_err(|source| SpoolError::Folder { path: path.to_owned(), source })
    }

    /// Creates the folder `path` if it does not exist, and locks it for a writer.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Busy`] if another writer has it; [`SpoolError::Folder`] if it is a link,
    /// belongs to another user, or cannot be made durable.
    pub fn locked(path: &Path) -> Result<SpoolFolder, SpoolError> {
        let failed = |source| SpoolError::Folder { path: path.to_owned(), source };
        safe_file::folder(path).map_err(failed)?;
        let locked = SpoolFolder::readable(path)?;
        if locked.owner != rustix::process::geteuid().as_raw() {
            return Err(failed(foreign(locked.owner)));
        }
        match flock(&locked.folder, FlockOperation::NonBlockingLockExclusive) {
            Err(rustix::io::Errno::WOULDBLOCK) => {
                let pid = locked.folder.metadata().ok().and_then(|found| holder(found.ino()));
                return Err(SpoolError::Busy { path: path.to_owned(), pid });
            }
            other => other.map_err(|error| failed(error.into()))?,
        }
        // The name of the folder must survive a power cut, too.
        let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let synced = File::open(parent.unwrap_or(Path::new("."))).and_then(|it| it.sync_all());
        synced.map_err(failed)?;
        Ok(locked)
    }

    fn segment(&self, first: u64) -> PathBuf {
        self.path.join(segment_name(first))
    }

    /// Refuses what is not a plain file of the folder's owner with one name.
    fn must_be_plain(&self, path: &Path, found: &fs::Metadata) -> io::Result<()> {
        let unsafe_path = match found.file_type() {
            kind if kind.is_symlink() => Some(UnsafePath::Link),
            kind if !kind.is_file() => Some(UnsafePath::NoFile),
            _ if found.nlink() > 1 => Some(UnsafePath::HardLink),
            _ => None,
        };
        let why = match unsafe_path {
            Some(why) => io::Error::other(why),
            None if found.uid() != self.owner => foreign(found.uid()),
            None => return Ok(()),
        };
        Err(io::Error::other(format!("`{}` is not a segment: {why}", path.display())))
    }
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
    digits.parse().ok().filter(|first| all_digits && *first < crate::format::SEQ_END)
}

impl SpoolStorage for SpoolFolder {
    type File = File;

    fn list(&self) -> io::Result<Vec<(u64, u64)>> {
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            let entry = entry?;
            let Some(first) = entry.file_name().to_str().and_then(first_of) else { continue };
            let metadata = match entry.metadata() {
                // Removed meanwhile.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                other => other?,
            };
            self.must_be_plain(&entry.path(), &metadata)?;
            found.push((first, metadata.len()));
        }
        found.sort_unstable();
        Ok(found)
    }

    fn names(&self) -> io::Result<Vec<u64>> {
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            found.extend(entry?.file_name().to_str().and_then(first_of));
        }
        found.sort_unstable();
        Ok(found)
    }

    fn create(&self, first: u64) -> io::Result<File> {
        safe_file::create(&self.segment(first))
    }

    fn open(&self, first: u64) -> io::Result<File> {
        let path = self.segment(first);
        let file = safe_file::read(&path)?;
        self.must_be_plain(&path, &file.metadata()?)?;
        Ok(file)
    }

    fn remove(&self, first: u64) -> io::Result<()> {
        fs::remove_file(self.segment(first))
    }

    fn sync_names(&self) -> io::Result<()> {
        self.folder.sync_all()
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
