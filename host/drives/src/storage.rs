//! Opens the files of a drive, each with the reader of its format.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use tracing::warn;

use crate::bag::bag_of;
use crate::chunk::Opener;
#[cfg(feature = "bags")]
use crate::damage::Damage;
#[cfg(feature = "bags")]
use crate::database::{self, DatabaseFile};
use crate::error::ReplayError;
use crate::file::Contents;
use crate::options::DriveOptions;
use crate::scan::scan;
use crate::source::{FileKind, START, SourceFile};
use crate::track::{Store, Track};
#[cfg(feature = "bags")]
use crate::unpack::unpack_one;
#[cfg(feature = "bags")]
use crate::unpacked::Unpacked;
use crate::writers::Writers;

/// Opens all files of `paths`. Returns them, and the path of each recording: a file, or a directory
/// whose metadata state that its files are one.
pub fn open(
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
            database(DatabaseFile::beside_its_journal(path), source.len(), options)
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
    file: DatabaseFile<'_>,
    len: u64,
    options: &DriveOptions,
) -> Result<(Store, Contents), ReplayError> {
    let (rows, contents) = database::open(file, len, options.limits)?;
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
        FileKind::Database => {
            let name = unpacked.name(options)?;
            database(DatabaseFile::elsewhere(path, name.as_ref()), len, options)?
        }
        FileKind::Packed => return Err(ReplayError::NotMcap { path: path.clone() }),
    };
    if let Some(error) = &unpacked.broken {
        let error = std::io::Error::other(error.clone());
        contents.damage.get_or_insert((len, Damage::UnpackedInPart(error)));
    }
    Ok((store, contents))
}
