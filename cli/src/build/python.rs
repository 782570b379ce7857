//! Python: the files that make up a lambda.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use super::error::BuildError;

/// Folders beside the manifest that are no part of the lambda: what tools made, and its tests.
const LEFT_OUT: [&str; 4] = ["build", "out", "target", "tests"];

/// Every `.py` file of the lambda in `dir`, relative to it, in the order of their names. Hidden folders such as `.venv`
/// are left out, and links to folders are not followed: they may lead in circles.
pub(super) fn sources(dir: &Path) -> Result<Vec<PathBuf>, BuildError> {
    let mut found = Vec::new();
    let mut folders = vec![PathBuf::new()];
    while let Some(folder) = folders.pop() {
        let path = dir.join(&folder);
        let failed = |source| BuildError::File { action: "list", path: path.clone(), source };
        for entry in fs::read_dir(&path).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let relative = folder.join(entry.file_name());
            if entry.file_type().map_err(failed)?.is_dir() {
                if is_of_the_lambda(&relative) {
                    folders.push(relative);
                }
            } else if relative.extension() == Some(OsStr::new("py")) && entry.path().is_file() {
                found.push(relative);
            }
        }
    }
    found.sort();
    Ok(found)
}

fn is_of_the_lambda(folder: &Path) -> bool {
    let name = folder.file_name().unwrap_or_default();
    let left_out = LEFT_OUT.iter().any(|left_out| folder == Path::new(left_out)) || name == "__pycache__";
    !left_out && !name.as_encoded_bytes().starts_with(b".")
}
