//! Test data that cannot be in the project: recordings, pictures and models of others.

use std::path::{Path, PathBuf};

/// The file `data/NAME` in the folder that the variable `GLEANER_SHARED` names; otherwise the
/// reason why a test that needs it is skipped.
pub fn shared_file(name: &str) -> Result<PathBuf, String> {
    let folder = std::env::var_os("GLEANER_SHARED").filter(|folder| !folder.is_empty());
    let path = folder.map(|folder| Path::new(&folder).join("data").join(name));
    path.filter(|path| path.exists())
        .ok_or_else(|| format!("set GLEANER_SHARED to the folder that has data/{name}"))
}
