//! Packed files: their content, in a file without a name.
//!
//! A packed file cannot be read from where one likes, and messages are not in the order of their
//! times. So it is unpacked once, to the disk, which has more room than memory. The content has no
//! name, so nothing of it stays when the process is killed.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rustix::fs::{AtFlags, CWD, Mode, OFlags, fstatvfs, linkat, open};
use rustix::io::Errno;
use rustix::process::geteuid;
use tempfile::{Builder, TempPath};
use tracing::warn;
use zstd::stream::read::Decoder;

use super::error::ReplayError;
use super::options::Options;
use super::source::Source;
use super::storage::{Kind, START, files_of};

/// Written at once.
const PIECE: usize = 1 << 20;
/// How many times its own size a packed file may hold. Sensor data packs to a half or a tenth,
/// pictures of nothing to a thousandth, and a bomb to less.
const RATIO: u64 = 200;
/// The share of all that may be unpacked which one file may take in any case.
const SHARE: u64 = 64;
/// How the names begin that content has for a moment, and had all the time in earlier versions.
const PREFIX: &str = ".unpacked-";
/// A file of such a name that was not written to for so long belongs to a process that was killed.
const STALE: Duration = Duration::from_secs(3600);

/// The content of a packed file.
#[derive(Clone, Debug)]
pub struct Unpacked {
    /// The packed file, as it is named among the files of the drive.
    pub(super) path: PathBuf,
    pub(super) content: Arc<File>,
    /// Why there is no more of it, though there should be.
    pub(super) broken: Option<String>,
    /// The name that it has already.
    name: Option<Name>,
}

/// A name of the content of a packed file.
#[derive(Clone, Debug)]
pub enum Name {
    /// Removed with the last clone.
    Ours(Arc<TempPath>),
    /// Given by the process that unpacked it, and removed there.
    Given(PathBuf),
}

impl AsRef<Path> for Name {
    fn as_ref(&self) -> &Path {
        match self {
            Self::Ours(name) => name,
            Self::Given(name) => name,
        }
    }
}

/// What bounds the content of a file.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Bound {
    /// All packed files together.
    Drive(u64),
    /// Its own size.
    Ratio(u64),
    /// The room on the disk.
    Disk(u64),
}

impl Bound {
    /// The smallest of a file of `packed` bytes, where all files may take `room` of `most` bytes in
    /// all, on a disk with `free` bytes.
    fn smallest(packed: u64, room: u64, most: u64, free: u64) -> Self {
        let by_size = packed.saturating_mul(RATIO).max(most / SHARE);
        // The rest is for the results, and for others.
        let bounds = [Self::Disk(free / 10 * 9), Self::Ratio(by_size), Self::Drive(room)];
        bounds.into_iter().min_by_key(|bound| bound.bytes()).expect("there are three")
    }

    fn bytes(self) -> u64 {
        let (Self::Drive(bytes) | Self::Ratio(bytes) | Self::Disk(bytes)) = self;
        bytes
    }

    fn exceeded(self, path: &Path, folder: &Path, options: &Options) -> ReplayError {
        let path = path.to_owned();
        match self {
            Self::Drive(_) => {
                ReplayError::UnpacksTooLarge { path, allowed: options.limits.unpacked_bytes }
            }
            Self::Ratio(allowed) => ReplayError::UnpacksManyTimes { path, allowed },
            Self::Disk(allowed) => ReplayError::NoRoom { path, folder: folder.to_owned(), allowed },
        }
    }
}

/// Unpacks the files of a drive that are packed. A process that may write does it for one that may
/// not, which opens the drive with [`Options::unpacked`].
///
/// # Errors
///
/// As [`Replay::open`](super::Replay::open), of what concerns these files.
pub fn unpack(paths: &[PathBuf], options: &Options) -> Result<Vec<Unpacked>, ReplayError> {
    let mut room = options.limits.unpacked_bytes;
    let mut unpacked = Vec::new();
    for path in files_of(paths)? {
        let mut source = Source::open(&path)?;
        if matches!(Kind::of(source.peek(0, START)?), Some(Kind::Packed)) {
            unpacked.push(unpack_one(source, options, &mut room)?);
        }
    }
    Ok(unpacked)
}

/// Unpacks what is in `source`, if it is something that we read. What that takes is taken from
/// `room`.
pub(super) fn unpack_one(
    source: Source,
    options: &Options,
    room: &mut u64,
) -> Result<Unpacked, ReplayError> {
    let (path, packed) = (source.path().to_owned(), source.len());
    let folder = folder(options);
    let failed =
        |source| ReplayError::Unpack { path: path.clone(), folder: folder.clone(), source };
    let mut decoder = Decoder::new(source.into_file()).map_err(failed)?;
    let mut start = Vec::new();
    decoder.by_ref().take(START as u64).read_to_end(&mut start).map_err(failed)?;
    let is_database = match Kind::of(&start) {
        Some(Kind::Mcap) => false,
        Some(Kind::Database) => true,
        // The rest is not even unpacked.
        _ => return Err(ReplayError::NotMcap { path }),
    };
    remove_stale(&folder);
    let (mut file, name) = new_file(&folder, is_database).map_err(failed)?;
    let disk = fstatvfs(&file).map_err(|error| failed(error.into()))?;
    let free = disk.f_bavail.saturating_mul(disk.f_frsize);
    let bound = Bound::smallest(packed, *room, options.limits.unpacked_bytes, free);
    let mut content = start.as_slice().chain(decoder);
    let (mut piece, mut len) = (vec![0; PIECE], 0);
    let broken = loop {
        match content.read(&mut piece) {
            Ok(0) => break None,
            Ok(n) => {
                len += n as u64;
                if len > bound.bytes() {
                    return Err(bound.exceeded(&path, &folder, options));
                }
                file.write_all(&piece[..n]).map_err(failed)?;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => {
                warn!(path = %path.display(), unpacked = len, %error, "drive can be unpacked only in part");
                break Some(error.to_string());
            }
        }
    };
    *room -= len;
    Ok(Unpacked { path, content: Arc::new(file), broken, name })
}

impl Unpacked {
    /// The content of the packed file `path`, which another process made by [`unpack`] and calls
    /// `name` for now; of a file that could be unpacked only in part, `broken` says why.
    ///
    /// # Errors
    ///
    /// Those of opening `name`.
    pub fn named(path: PathBuf, name: PathBuf, broken: Option<String>) -> io::Result<Self> {
        Ok(Self {
            path,
            content: Arc::new(File::open(&name)?),
            broken,
            name: Some(Name::Given(name)),
        })
    }

    /// The name that another process gave the content, if one did.
    pub fn given_name(&self) -> Option<&Path> {
        match &self.name {
            Some(Name::Given(name)) => Some(name),
            _ => None,
        }
    }

    /// The packed file, and why its content is not whole, if it is not.
    pub fn parts(&self) -> (&Path, Option<&str>) {
        (&self.path, self.broken.as_deref())
    }

    /// Names the content for as long as the result lives: SQLite opens by name only, and follows
    /// the links in `/proc` to names that are not there.
    ///
    /// # Errors
    ///
    /// [`ReplayError::Unpack`] names the folder in which there can be no such name.
    pub fn name(&self, options: &Options) -> Result<Name, ReplayError> {
        if let Some(name) = &self.name {
            return Ok(name.clone());
        }
        let folder = folder(options);
        let link = |name: &Path| {
            let content = format!("/proc/self/fd/{}", self.content.as_raw_fd());
            Ok(linkat(CWD, content, CWD, name, AtFlags::SYMLINK_FOLLOW)?)
        };
        match Builder::new().prefix(PREFIX).make_in(&folder, link) {
            Ok(named) => Ok(Name::Ours(Arc::new(named.into_temp_path()))),
            Err(source) => Err(ReplayError::Unpack { path: self.path.clone(), folder, source }),
        }
    }
}

fn folder(options: &Options) -> PathBuf {
    options.unpack_in.clone().unwrap_or_else(std::env::temp_dir)
}

/// A new file in `folder`, without a name where that is possible: some file systems, as those of
/// networks, have none such, and then a database keeps its name until it is open.
fn new_file(folder: &Path, is_database: bool) -> io::Result<(File, Option<Name>)> {
    let flags = OFlags::TMPFILE | OFlags::RDWR | OFlags::CLOEXEC;
    match open(folder, flags, Mode::RUSR | Mode::WUSR) {
        Ok(file) => Ok((file.into(), None)),
        Err(Errno::OPNOTSUPP | Errno::ISDIR) => {
            let (file, name) = Builder::new().prefix(PREFIX).tempfile_in(folder)?.into_parts();
            Ok((file, is_database.then(|| Name::Ours(Arc::new(name)))))
        }
        Err(error) => Err(error.into()),
    }
}

/// Removes content that processes left in `folder` that were killed: plain files of this user with
/// one name, to which nothing has been written for long. Content has a name only until it is
/// written, or opened.
fn remove_stale(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in
        entries.flatten().filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX))
    {
        // Of the entry itself: no link is followed.
        let Ok(found) = entry.metadata() else { continue };
        let is_ours = found.is_file() && found.uid() == geteuid().as_raw() && found.nlink() == 1;
        let is_stale = found.modified().is_ok_and(|at| at.elapsed().is_ok_and(|age| age >= STALE));
        if is_ours && is_stale {
            let path = entry.path();
            match fs::remove_file(&path) {
                Ok(()) => {
                    warn!(path = %path.display(), bytes = found.len(), "removed what a killed process unpacked")
                }
                Err(error) => {
                    warn!(path = %path.display(), %error, "cannot remove what a killed process unpacked")
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_bounded_by_its_size_by_the_disk_and_by_the_other_files() {
        const GIB: u64 = 1 << 30;
        let most = 64 * GIB;
        for (packed, room, free, expected) in [
            (2_000_000, most, 1000 * GIB, Bound::Ratio(GIB)),
            (GIB / 10, most, 1000 * GIB, Bound::Ratio(GIB / 10 * RATIO)),
            (GIB, most, 1000 * GIB, Bound::Drive(most)),
            (GIB, most, 10 * GIB, Bound::Disk(9 * GIB)),
            (u64::MAX, 7, u64::MAX, Bound::Drive(7)),
        ] {
            assert_eq!(Bound::smallest(packed, room, most, free), expected);
        }
    }
}
