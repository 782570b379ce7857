//! Steps of the file system that are on the disk when they return.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use crate::error::RecordError;

/// Makes the names in `folder` durable: a rename is on the disk only when its folder is.
pub(super) fn sync_folder(folder: &Path) -> Result<(), RecordError> {
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .map_err(|source| RecordError::Sync { path: folder.to_owned(), source })
}

/// Makes the content of `path` durable.
pub(super) fn sync_file(path: &Path) -> Result<(), RecordError> {
    File::open(path)
        .and_then(|file| file.sync_all())
        .map_err(|source| RecordError::Sync { path: path.to_owned(), source })
}

/// Gives the file `from`, whose content is durable, the name `to`.
pub(super) fn rename(from: &Path, to: &Path, folder: &Path) -> Result<(), RecordError> {
    fs::rename(from, to).map_err(|source| RecordError::Rename { from: from.to_owned(), to: to.to_owned(), source })?;
    sync_folder(folder)
}

/// Writes `to` by way of `part`, so that it is whole or not there.
pub(super) fn write(part: &Path, to: &Path, folder: &Path, content: &[u8]) -> Result<(), RecordError> {
    let mut file = File::create(part).map_err(|source| RecordError::Create { path: part.to_owned(), source })?;
    file.write_all(content).map_err(|source| RecordError::Write { path: part.to_owned(), source })?;
    file.sync_all().map_err(|source| RecordError::Sync { path: part.to_owned(), source })?;
    rename(part, to, folder)
}

/// Removes a file, and says whether it was there.
pub(super) fn remove(path: &Path) -> Result<bool, RecordError> {
    match fs::remove_file(path) {
        Ok(()) => Ok(true),
        Err(source) if source.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(source) => Err(RecordError::Remove { path: path.to_owned(), source }),
    }
}
