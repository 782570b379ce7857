//! From a component to its entry in the cache: compiled, written beside its place, synced and
//! renamed.

use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::prune::prune;
use super::{
    CACHE_BYTES, CODE_BYTES, CompileError, Entry, Found, GUEST_STACK_BYTES, Nans, NoComponent,
    engine, make_cache, read_component,
};

/// Compiles the component at `path` into `cache` and returns the entry; a healthy one is left as it
/// is, a damaged one replaced. So that the cache does not grow without end, what is beyond
/// [`CACHE_BYTES`] leaves it.
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
    let entry = Entry::of(cache, &component, nans);
    if let Found::Code(_) = entry.read()? {
        return Ok(entry.path().to_owned());
    }
    let code = engine(GUEST_STACK_BYTES, nans)?
        .precompile_component(&component)
        .map_err(|source| CompileError::Compile { path: path.to_owned(), source: source.into() })?;
    if code.len() > CODE_BYTES {
        return Err(CompileError::CodeTooLarge { path: path.to_owned(), bytes: code.len() });
    }
    let write = |source| CompileError::Write { path: entry.path().to_owned(), source };
    write_whole(entry.path(), &[&entry.head(&code), &code]).map_err(write)?;
    // What cannot leave today leaves when the next one comes.
    let _ = prune(cache, entry.path(), CACHE_BYTES);
    Ok(entry.path().to_owned())
}

/// Writes a file that is either whole or as it was before, whenever the power fails. A healthy file
/// is never missing on the way, so processes that replace a damaged one at once do not disturb each
/// other.
fn write_whole(path: &Path, parts: &[&[u8]]) -> io::Result<()> {
    let mut partial = begin_beside(path)?;
    parts.iter().try_for_each(|part| partial.write_all(part))?;
    partial.as_file().sync_all()?;
    partial.persist(path)?;
    Ok(())
}

/// Begins a file of a name of its own beside `path`. It stays locked until it is closed: one
/// without a lock was left by a killed process.
fn begin_beside(path: &Path) -> io::Result<NamedTempFile> {
    let (folder, name) = (path.parent().unwrap_or(path), path.file_stem().unwrap_or_default());
    loop {
        let partial = tempfile::Builder::new().prefix(name).suffix(".part").tempfile_in(folder)?;
        // Where locks do not work, no process takes one to remove it either.
        let _ = partial.as_file().lock();
        // Another process may have removed it before it was locked, and cannot from here on.
        if partial.as_file().metadata()?.nlink() > 0 {
            return Ok(partial);
        }
    }
}
