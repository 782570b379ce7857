//! File system operations that are on the disk when they return.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::Path;

use gleaner_base::safe_file;

use super::recover::Pause;
use crate::error::RecordError;

/// Bytes to copy between two pauses.
const PIECE: u64 = 8 << 20;

/// Makes the names in `folder` durable: a rename is on the disk only when its folder is.
pub(super) fn sync_folder(folder: &Path) -> Result<(), RecordError> {
    sync_file(folder)
}

/// Makes the content of `path` durable.
pub(super) fn sync_file(path: &Path) -> Result<(), RecordError> {
    step("sync", path)
        .and_then(|()| File::open(path)?.sync_all())
        .map_err(|source| RecordError::Sync { path: path.to_owned(), source })
}

/// Renames the file `from`, whose content is durable, to `to`.
pub(super) fn rename(from: &Path, to: &Path, folder: &Path) -> Result<(), RecordError> {
    step("rename", to).and_then(|()| fs::rename(from, to)).map_err(|source| {
        RecordError::Rename { from: from.to_owned(), to: to.to_owned(), source }
    })?;
    sync_folder(folder)
}

/// Writes `to` atomically, by way of `part`.
pub(super) fn write(
    part: &Path,
    to: &Path,
    folder: &Path,
    content: &[u8],
) -> Result<(), RecordError> {
    write_with(part, to, folder, |file| file.write_all(content))
}

/// Writes `to` as [`write`] does, with the content that `fill` writes.
pub(super) fn write_with(
    part: &Path,
    to: &Path,
    folder: &Path,
    fill: impl FnOnce(&mut File) -> io::Result<()>,
) -> Result<(), RecordError> {
    let mut file = safe_file::create(part)
        .map_err(|source| RecordError::Create { path: part.to_owned(), source })?;
    fill(&mut file).map_err(|source| RecordError::Write { path: part.to_owned(), source })?;
    file.sync_all().map_err(|source| RecordError::Sync { path: part.to_owned(), source })?;
    rename(part, to, folder)
}

/// Copies the content of `from` into the new file `to`, and syncs it. So the content that was read
/// is on the disk, even if an earlier sync of `from` had failed.
pub(super) fn copy(from: &Path, to: &Path, pause: &mut Pause) -> Result<(), RecordError> {
    let cannot_write = |source| RecordError::Write { path: to.to_owned(), source };
    let source = safe_file::read(from)
        .map_err(|source| RecordError::Read { path: from.to_owned(), source })?;
    let copy = step("copy", to).and_then(|()| File::create_new(to));
    let mut copy = copy.map_err(|source| RecordError::Create { path: to.to_owned(), source })?;
    while io::copy(&mut (&source).take(PIECE), &mut copy).map_err(cannot_write)? > 0 {
        pause()?;
    }
    sync_file(to)
}

/// Removes a file. Returns whether it existed.
pub(super) fn remove(path: &Path) -> Result<bool, RecordError> {
    match step("remove", path).and_then(|()| fs::remove_file(path)) {
        Ok(()) => Ok(true),
        Err(source) if source.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(source) => Err(RecordError::Remove { path: path.to_owned(), source }),
    }
}

/// Called before each step; does nothing. In tests, another function replaces this one: it records
/// the steps, and can fail any of them.
#[cfg(not(test))]
pub(super) fn step(_: &str, _: &Path) -> io::Result<()> {
    Ok(())
}

#[cfg(test)]
pub(super) use steps::step;

#[cfg(test)]
pub(super) mod steps {
    use std::cell::RefCell;

    use super::*;

    thread_local! {
        static STEPS: RefCell<(Vec<String>, usize)> =
            const { RefCell::new((Vec::new(), usize::MAX)) };
    }

    /// Restarts the count; every step after `last` steps fails, as if the process had died.
    pub fn restart(last: usize) {
        STEPS.set((Vec::new(), last));
    }

    pub fn taken() -> Vec<String> {
        STEPS.with_borrow(|(taken, _)| taken.clone())
    }

    pub fn step(what: &str, path: &Path) -> io::Result<()> {
        STEPS.with_borrow_mut(|(taken, last)| {
            if taken.len() == *last {
                return Err(io::Error::other("dead"));
            }
            taken.push(format!("{what} {}", path.file_name().unwrap_or_default().display()));
            Ok(())
        })
    }
}
