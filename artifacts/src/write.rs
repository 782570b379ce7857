//! Writes an entry as a whole, or not at all.

use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use tempfile::NamedTempFile;

/// Writes a file atomically, even if the power fails. The file is never missing meanwhile, so
/// processes that replace a damaged one at the same time do not disturb each other.
pub(crate) fn write_whole(path: &Path, parts: &[&[u8]]) -> io::Result<()> {
    let mut partial = begin_beside(path)?;
    parts.iter().try_for_each(|part| partial.write_all(part))?;
    partial.as_file().sync_all()?;
    partial.persist(path)?;
    Ok(())
}

/// Creates a file with a unique name beside `path`. It stays locked until it is closed: a file
/// without a lock was left by a killed process.
fn begin_beside(path: &Path) -> io::Result<NamedTempFile> {
    let (folder, name) = (path.parent().unwrap_or(path), path.file_stem().unwrap_or_default());
    loop {
        let partial = tempfile::Builder::new().prefix(name).suffix(".part").tempfile_in(folder)?;
        // Where locks do not work, no process can lock and remove it either.
        let _ = partial.as_file().lock();
        // Another process may have removed it before it was locked; now it cannot.
        if partial.as_file().metadata()?.nlink() > 0 {
            return Ok(partial);
        }
    }
}
