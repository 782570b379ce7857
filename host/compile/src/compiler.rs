//! From a component to its entry in the cache: compiled, written beside its place, synced and renamed.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use super::prune::prune;
use super::{
    CACHE_BYTES, CODE_BYTES, CompileError, GUEST_STACK_BYTES, Nans, cache_entry, check_folder, engine, make_cache,
    note_use, read_component,
};

/// Compiles the component at `path` into `cache` and returns the entry; an entry that exists is left as it is. So that the cache does
/// not grow without end, what is beyond [`CACHE_BYTES`] leaves it.
///
/// # Errors
///
/// [`CompileError`] names the component and the cause.
pub fn compile(path: &Path, cache: &Path, nans: Nans) -> Result<PathBuf, CompileError> {
    let component = read_component(path)?;
    make_cache(cache)?;
    check_folder(cache)?;
    let entry = cache_entry(cache, &component, nans);
    if let Ok(code) = File::open(&entry) {
        note_use(&code);
        return Ok(entry);
    }
    let code = engine(GUEST_STACK_BYTES, nans)?
        .precompile_component(&component)
        .map_err(|source| CompileError::Compile { path: path.to_owned(), source: source.into() })?;
    if code.len() > CODE_BYTES {
        return Err(CompileError::CodeTooLarge { path: path.to_owned(), bytes: code.len() });
    }
    write_whole(&entry, &code).map_err(|source| CompileError::Write { path: entry.clone(), source })?;
    // What cannot leave today leaves when the next one comes.
    let _ = prune(cache, &entry, CACHE_BYTES);
    Ok(entry)
}

/// Writes a file that is either absent or whole, whenever the power fails.
fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // The name is our own, so two processes that compile the same component do not write into one file. What an earlier
    // process of the same number left is in the way.
    let partial = path.with_extension(format!("{}.part", std::process::id()));
    let _ = fs::remove_file(&partial);
    let written = (|| {
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&partial)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&partial, path)
    })();
    if written.is_err() {
        let _ = fs::remove_file(&partial);
    }
    written
}
