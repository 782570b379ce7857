//! Compiles a component into the store.

use std::path::{Path, PathBuf};

use gleaner_artifacts::{StoreLookup, make_store};

use super::{
    CODE_BYTES, CompileError, GUEST_STACK_BYTES, Nans, NoComponent, code_entry, engine,
    read_component,
};

/// Compiles the component at `path` into the folder `store` and returns the path of the entry. A
/// healthy entry is kept, a damaged one replaced.
pub fn compile(path: &Path, store: &Path, nans: Nans) -> Result<PathBuf, CompileError> {
    let component = read_component(path)?;
    if let Some(why) = NoComponent::of(&component) {
        return Err(CompileError::NoComponent { path: path.to_owned(), why });
    }
    make_store(store)?;
    let entry = code_entry(store, &component, nans);
    if let StoreLookup::Content(_) = entry.read()? {
        return Ok(entry.path().to_owned());
    }
    let code = engine(GUEST_STACK_BYTES, nans)?
        .precompile_component(&component)
        .map_err(|source| CompileError::Compile { path: path.to_owned(), source: source.into() })?;
    if code.len() > CODE_BYTES {
        return Err(CompileError::CodeTooLarge { path: path.to_owned(), bytes: code.len() });
    }
    entry.put(&[&code])?;
    Ok(entry.path().to_owned())
}
