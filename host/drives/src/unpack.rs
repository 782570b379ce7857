//! Unpacks packed files, each into a file without a name.
//!
//! A packed file has no random access, and messages are not in the order of their times. So it is
//! unpacked once, to the disk, which has more space than memory. The content has no name, so it
//! disappears when the process is killed.

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
use tempfile::Builder;
use tracing::warn;
use zstd::stream::read::Decoder;

use crate::bag::files_of;
use crate::error::ReplayError;
use crate::options::DriveOptions;
use crate::source::{FileKind, START, SourceFile};
use crate::unpacked::{ContentName, Unpacked};

/// Size of a write, in bytes.
const PIECE: usize = 1 << 20;
/// Limit of the unpacked size, as a multiple of the packed size. Sensor data packs to a half or a
/// tenth, blank pictures to a thousandth, and a bomb to less.
const RATIO: u64 = 200;
/// The share of the total limit that any file may take.
const SHARE: u64 = 64;
/// Prefix of the names that content has temporarily, and had permanently in earlier versions.
const PREFIX: &str = ".unpacked-";
/// Age since the last write from which a file of such a name belongs to a killed process.
const STALE: Duration = Duration::from_secs(3600);

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum SizeLimit {
    /// The limit of all packed files together.
    Drive(u64),
    /// The limit for its own size.
    Ratio(u64),
    Disk(u64),
}

impl SizeLimit {
    /// Returns the smallest limit for a file of `packed` bytes, where all files may take `room` of
    /// `total` bytes in all, on a disk with `free` bytes.
    fn smallest(packed: u64, room: u64, total: u64, free: u64) -> Self {
        let by_size = packed.saturating_mul(RATIO).max(total / SHARE);
        // The rest is for the results, and for other programs.
        let bounds = [Self::Disk(free / 10 * 9), Self::Ratio(by_size), Self::Drive(room)];
        bounds.into_iter().min_by_key(|bound| bound.bytes()).expect("there are three")
    }

    fn bytes(self) -> u64 {
        let (Self::Drive(bytes) | Self::Ratio(bytes) | Self::Disk(bytes)) = self;
        bytes
    }

    fn exceeded(self, path: &Path, folder: &Path, options: &DriveOptions) -> ReplayError {
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

/// Unpacks the packed files of a drive. A process with write access does this for one without,
/// which opens the drive with [`DriveOptions::unpacked`].
///
/// # Errors
///
/// As [`Replay::open`](crate::Replay::open), for these files.
pub fn unpack(paths: &[PathBuf], options: &DriveOptions) -> Result<Vec<Unpacked>, ReplayError> {
    let mut room = options.limits.unpacked_bytes;
    let mut unpacked = Vec::new();
    for path in files_of(paths)? {
        let mut source = SourceFile::open(&path)?;
        if matches!(FileKind::of(source.peek(0, START)?), Some(FileKind::Packed)) {
            unpacked.push(unpack_one(source, options, &mut room)?);
        }
    }
    Ok(unpacked)
}

/// Unpacks `source`, if the content has a supported format, and subtracts its size from `room`.
pub(super) fn unpack_one(
    source: SourceFile,
    options: &DriveOptions,
    room: &mut u64,
) -> Result<Unpacked, ReplayError> {
    let (path, packed) = (source.path().to_owned(), source.len());
    let folder = folder(options);
    let failed =
        |source| ReplayError::Unpack { path: path.clone(), folder: folder.clone(), source };
    let mut decoder = Decoder::new(source.into_file()).map_err(failed)?;
    let mut start = Vec::new();
    decoder.by_ref().take(START as u64).read_to_end(&mut start).map_err(failed)?;
    let is_database = match FileKind::of(&start) {
        Some(FileKind::Mcap) => false,
        Some(FileKind::Database) => true,
        // The rest is not even unpacked.
        _ => return Err(ReplayError::NotMcap { path }),
    };
    remove_stale(&folder);
    let (mut file, name) = new_file(&folder, is_database).map_err(failed)?;
    let disk = fstatvfs(&file).map_err(|error| failed(error.into()))?;
    let free = disk.f_bavail.saturating_mul(disk.f_frsize);
    let bound = SizeLimit::smallest(packed, *room, options.limits.unpacked_bytes, free);
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
                warn!(
                    path = %path.display(),
                    unpacked = len,
                    %error,
                    "drive can be unpacked only in part"
                );
                break Some(error.to_string());
            }
        }
    };
    *room -= len;
    Ok(Unpacked { path, content: Arc::new(file), broken, name })
}

impl Unpacked {
    /// Names the content for as long as the result lives: SQLite opens files by name only, and the
    /// links in `/proc` lead to names that do not exist.
    ///
    /// # Errors
    ///
    /// [`ReplayError::Unpack`] with the folder in which no such name can be created.
    pub fn name(&self, options: &DriveOptions) -> Result<ContentName, ReplayError> {
        if let Some(name) = &self.name {
            return Ok(name.clone());
        }
        let folder = folder(options);
        let link = |name: &Path| {
            let content = format!("/proc/self/fd/{}", self.content.as_raw_fd());
            Ok(linkat(CWD, content, CWD, name, AtFlags::SYMLINK_FOLLOW)?)
        };
        match Builder::new().prefix(PREFIX).make_in(&folder, link) {
            Ok(named) => Ok(ContentName::Own(Arc::new(named.into_temp_path()))),
            Err(source) => Err(ReplayError::Unpack { path: self.path.clone(), folder, source }),
        }
    }
}

fn folder(options: &DriveOptions) -> PathBuf {
    options.unpack_in.clone().unwrap_or_else(std::env::temp_dir)
}

/// Creates a file in `folder`, without a name if possible: some file systems, such as network ones,
/// do not support that, and then a database keeps its name until it is open.
fn new_file(folder: &Path, is_database: bool) -> io::Result<(File, Option<ContentName>)> {
    let flags = OFlags::TMPFILE | OFlags::RDWR | OFlags::CLOEXEC;
    match open(folder, flags, Mode::RUSR | Mode::WUSR) {
        Ok(file) => Ok((file.into(), None)),
        Err(Errno::OPNOTSUPP | Errno::ISDIR) => {
            let (file, name) = Builder::new().prefix(PREFIX).tempfile_in(folder)?.into_parts();
            Ok((file, is_database.then(|| ContentName::Own(Arc::new(name)))))
        }
        Err(error) => Err(error.into()),
    }
}

/// Removes content of killed processes from `folder`: regular files of this user with a single name
/// that were not written to for long. Content has a name only until it is written, or opened.
fn remove_stale(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in
        entries.flatten().filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX))
    {
        // Metadata of the entry itself: links are not followed.
        let Ok(found) = entry.metadata() else { continue };
        let is_own = found.is_file() && found.uid() == geteuid().as_raw() && found.nlink() == 1;
        let is_stale = found.modified().is_ok_and(|at| at.elapsed().is_ok_and(|age| age >= STALE));
        if is_own && is_stale {
            let path = entry.path();
            match fs::remove_file(&path) {
                Ok(()) => {
                    warn!(
                        path = %path.display(),
                        bytes = found.len(),
                        "removed content that a killed process unpacked"
                    )
                }
                Err(error) => {
                    warn!(
                        path = %path.display(),
                        %error,
                        "cannot remove content that a killed process unpacked"
                    )
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_content_of_a_file_is_limited_by_its_size_the_disk_and_other_files() {
        const GIB: u64 = 1 << 30;
        let total = 64 * GIB;
        for (packed, room, free, expected) in [
            (2_000_000, total, 1000 * GIB, SizeLimit::Ratio(GIB)),
            (GIB / 10, total, 1000 * GIB, SizeLimit::Ratio(GIB / 10 * RATIO)),
            (GIB, total, 1000 * GIB, SizeLimit::Drive(total)),
            (GIB, total, 10 * GIB, SizeLimit::Disk(9 * GIB)),
            (u64::MAX, 7, u64::MAX, SizeLimit::Drive(7)),
        ] {
            assert_eq!(SizeLimit::smallest(packed, room, total, free), expected);
        }
    }
}
