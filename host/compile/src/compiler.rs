//! Compiles a component and writes it to the cache atomically.

use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::prune::prune;
use super::{
    CACHE_BYTES, CODE_BYTES, CacheEntry, CacheLookup, CompileError, GUEST_STACK_BYTES, Nans,
    NoComponent, engine, make_cache, read_component,
};

/// Compiles the component at `path` into `cache` and returns the path of the entry. A healthy entry
/// is kept, a damaged one replaced. Then removes the least recently used entries beyond
/// [`CACHE_BYTES`].
///
/// # Errors
///
/// [`CompileError`] names the component and the cause.
pub fn compile(path: &Path, cache: &Path, nans: Nans) -> Result<PathBuf, CompileError> {
    let component = read_component(path)?;
    if let Some(why) = NoComponent::of(&component) {
        return Err(CompileError::NoComponent { path: path.to_owned(), why });
    }
    make_cache(cache)?;
    let entry = CacheEntry::of(cache, &component, nans);
    if let CacheLookup::Code(_) = entry.read()? {
        return Ok(entry.path().to_owned());
    }
    let code = engine(GUEST_STACK_BYTES, nans)?
        .precompile_component(&component)
        .map_err(|source| CompileError::Compile { path: path.to_owned(), source: source.into() })?;
    if code.len() > CODE_BYTES {
        return Err(CompileError::CodeTooLarge { path: path.to_owned(), bytes: code.len() });
    }
    let write = |source| CompileError::Write { path: entry.path().to_owned(), source };
    write_atomically(entry.path(), &[&entry.head(&code), &code]).map_err(write)?;
    // Entries that cannot be removed now are removed with a later one.
    let _ = prune(cache, entry.path(), CACHE_BYTES);
    Ok(entry.path().to_owned())
}

/// Writes a file atomically, even if the power fails. The file is never missing meanwhile, so
/// processes that replace a damaged one at the same time do not disturb each other.
fn write_atomically(path: &Path, parts: &[&[u8]]) -> io::Result<()> {
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
