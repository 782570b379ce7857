//! Finds the files of a drive: each file itself, and those of rosbag2 directories.

#[cfg(feature = "bags")]
mod directory;

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use crate::error::ReplayError;

#[derive(Default)]
pub struct Bag {
    /// In the order of the metadata.
    pub files: Vec<PathBuf>,
    /// Messages by topic, in all files; empty if unknown.
    pub messages: BTreeMap<String, u64>,
    /// Set if metadata state that the files are one recording.
    pub is_one: bool,
    /// A note for the user, in a sentence.
    pub remark: Option<String>,
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
/// [`crate::Replay`] checks whether they exist.
pub fn journals_of(path: &Path) -> [PathBuf; 2] {
    ["-wal", "-journal"]
        .map(|suffix| OsString::from_iter([path.as_os_str(), suffix.as_ref()]).into())
}

/// Returns the files of a path: a file alone, or those of a directory.
pub fn bag_of(path: &Path) -> Result<Bag, ReplayError> {
    if !path.is_dir() {
        return Ok(Bag { files: vec![path.to_owned()], ..Bag::default() });
    }
    #[cfg(feature = "bags")]
    return directory::list(path);
    #[cfg(not(feature = "bags"))]
    Err(ReplayError::NotBuiltIn { path: path.to_owned(), what: "a rosbag2 directory" })
}
