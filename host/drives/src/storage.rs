//! Finds the files of a drive, and the reader of each of them.

use std::collections::{BTreeMap, HashSet};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use tracing::warn;

use super::chunk::Opener;
#[cfg(feature = "bags")]
use super::damage::Damage;
use super::error::ReplayError;
use super::file::Contents;
use super::options::DriveOptions;
use super::records::MAGIC;
use super::scan::scan;
use super::source::SourceFile;
use super::track::{Store, Track};
#[cfg(feature = "bags")]
use super::unpack::{Unpacked, unpack_one};
use super::writers::Writers;

#[derive(Default)]
pub(super) struct Bag {
    /// In the order of the metadata.
    pub(super) files: Vec<PathBuf>,
    /// Messages by topic, in all files; empty if unknown.
    pub(super) messages: BTreeMap<String, u64>,
    /// Set if metadata state that the files are one recording.
    pub(super) is_one: bool,
    /// A note for the user, in a sentence.
    pub(super) remark: Option<String>,
}

/// Returns the files that these paths name: each file itself, and those of a rosbag2 directory.
///
/// # Errors
///
/// [`ReplayError`] if a directory is not one of rosbag2, or its metadata cannot be used.
pub fn files_of(paths: &[PathBuf]) -> Result<Vec<PathBuf>, ReplayError> {
    paths
        .iter()
        .map(|path| Ok(bag_of(path)?.files))
        .collect::<Result<Vec<_>, _>>()
        .map(|files| files.concat())
}

/// Returns the paths where SQLite keeps changes that are not yet in the database `path`;
/// [`super::Replay`] checks whether they exist.
pub fn journals_of(path: &Path) -> [PathBuf; 2] {
    ["-wal", "-journal"]
        .map(|suffix| OsString::from_iter([path.as_os_str(), suffix.as_ref()]).into())
}

/// Returns the files of a path: a file alone, or those of a directory.
fn bag_of(path: &Path) -> Result<Bag, ReplayError> {
    if !path.is_dir() {
        return Ok(Bag { files: vec![path.to_owned()], ..Bag::default() });
    }
    #[cfg(feature = "bags")]
    return super::bag::list(path);
    #[cfg(not(feature = "bags"))]
    Err(ReplayError::NotBuiltIn { path: path.to_owned(), what: "a rosbag2 directory" })
}

/// Opens all files of `paths`. Returns them, and the path of each recording: a file, or a directory
/// whose metadata state that its files are one.
pub(super) fn open(
    paths: &[PathBuf],
    options: &DriveOptions,
    opener: &mut Opener,
) -> Result<(Vec<Track>, Vec<PathBuf>), ReplayError> {
    let mut writers = Writers::default();
    let mut tracks = Vec::new();
    let mut seen = HashSet::new();
    let mut room = options.limits.unpacked_bytes;
    let mut recordings = Vec::new();
    for path in paths {
        let bag = bag_of(path)?;
        if let Some(remark) = &bag.remark {
            warn!(path = %path.display(), "{remark}");
        }
        let mut files = Vec::new();
        for file in &bag.files {
            let is_empty = std::fs::metadata(file).is_ok_and(|found| found.len() == 0);
            if is_empty && bag.files.len() > 1 {
                let file = file.display();
                warn!(%file, "skipped an empty file of a recording, as a killed recorder leaves it");
                continue;
            }
            if std::fs::canonicalize(file).is_ok_and(|real| !seen.insert(real)) {
                return Err(ReplayError::Twice { path: file.clone() });
            }
            files.push(open_file(file, options, opener, &mut room)?);
        }
        count(&mut files, &bag.messages);
        recordings.extend(bag.is_one.then(|| path.clone()));
        for (store, contents) in files {
            let file = || store.path().to_owned();
            recordings.extend((!bag.is_one).then(file));
            tracks.push(Track::new(store, contents, &mut writers, recordings.len() - 1));
        }
    }
    Ok((tracks, recordings))
}

/// Gives files without counts the number of messages of the metadata. With several files, the share
/// of each is unknown: then the first that has the topic counts for all.
fn count(files: &mut [(Store, Contents)], messages: &BTreeMap<String, u64>) {
    if messages.is_empty() || files.iter().any(|(_, contents)| !contents.uncounted) {
        return;
    }
    let is_alone = files.len() == 1;
    let mut left = messages.clone();
    for (_, contents) in files {
        let channels = contents.channels.iter();
        contents.messages =
            channels.filter_map(|(id, info)| Some((id, left.remove(&info.topic)?))).collect();
        contents.claimed = is_alone && contents.messages.len() == contents.channels.len();
        contents.uncounted = false;
    }
}

/// Format of a file, by its first bytes, as file names are not reliable.
pub(super) enum FileKind {
    Mcap,
    Database,
    Packed,
}

/// Number of bytes that determine the format.
pub(super) const START: usize = 16;

impl FileKind {
    pub(super) fn of(start: &[u8]) -> Option<Self> {
        if start.starts_with(MAGIC) {
            Some(Self::Mcap)
        } else if start == b"SQLite format 3\0" {
            Some(Self::Database)
        } else if start.starts_with(&super::inflate::ZSTD) {
            Some(Self::Packed)
        } else {
            None
        }
    }
}

fn kind_of(source: &mut SourceFile) -> Result<FileKind, ReplayError> {
    if source.len() == 0 {
        return Err(ReplayError::Empty { path: source.path().to_owned() });
    }
    let kind = FileKind::of(source.peek(0, START)?);
    kind.ok_or_else(|| ReplayError::NotMcap { path: source.path().to_owned() })
}

fn open_file(
    path: &Path,
    options: &DriveOptions,
    opener: &mut Opener,
    room: &mut u64,
) -> Result<(Store, Contents), ReplayError> {
    #[cfg(feature = "bags")]
    if let Some(unpacked) = options.unpacked.iter().find(|unpacked| unpacked.path == path) {
        return content(unpacked, options, opener);
    }
    let mut source = SourceFile::open(path)?;
    match kind_of(&mut source)? {
        FileKind::Mcap => mcap(source, opener),
        #[cfg(feature = "bags")]
        FileKind::Database => {
            database(super::database::DatabaseFile::beside_its_journal(path), source.len(), options)
        }
        #[cfg(feature = "bags")]
        FileKind::Packed => content(&unpack_one(source, options, room)?, options, opener),
        #[cfg(not(feature = "bags"))]
        kind => {
            let _ = (options, room);
            let what =
                if matches!(kind, FileKind::Packed) { "packed with zstd" } else { "a database" };
            Err(ReplayError::NotBuiltIn { path: path.to_owned(), what })
        }
    }
}

fn mcap(mut source: SourceFile, opener: &mut Opener) -> Result<(Store, Contents), ReplayError> {
    let contents = scan(&mut source, opener)?;
    Ok((Store::Mcap(source), contents))
}

#[cfg(feature = "bags")]
fn database(
    file: super::database::DatabaseFile<'_>,
    len: u64,
    options: &DriveOptions,
) -> Result<(Store, Contents), ReplayError> {
    let (rows, contents) = super::database::open(file, len, options.limits)?;
    Ok((Store::Rows(Box::new(rows)), contents))
}

#[cfg(feature = "bags")]
fn content(
    unpacked: &Unpacked,
    options: &DriveOptions,
    opener: &mut Opener,
) -> Result<(Store, Contents), ReplayError> {
    let path = &unpacked.path;
    let mut source = SourceFile::over(unpacked.content.clone(), path)?;
    let len = source.len();
    let (store, mut contents) = match kind_of(&mut source)? {
        FileKind::Mcap => mcap(source, opener)?,
        FileKind::Database => database(
            super::database::DatabaseFile::elsewhere(path, unpacked.name(options)?.as_ref()),
            len,
            options,
        )?,
        FileKind::Packed => return Err(ReplayError::NotMcap { path: path.clone() }),
    };
    if let Some(error) = &unpacked.broken {
        let error = std::io::Error::other(error.clone());
        contents.damage.get_or_insert((len, Damage::UnpackedInPart(error)));
    }
    Ok((store, contents))
}
