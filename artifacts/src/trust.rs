//! Checks that only this user can write to a file and the folders above it.

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

const OTHER_OWNER: &str = "it belongs to another user";

/// Checks that only this user can put files into `folder`, or replace it. Otherwise returns the
/// path that others can write to, and the reason.
pub(crate) fn check_folder(folder: &Path) -> io::Result<Result<(), (PathBuf, &'static str)>> {
    let whole = fs::canonicalize(folder)?;
    for (above, path) in whole.ancestors().enumerate() {
        let meta = fs::symlink_metadata(path)?;
        let root_owns = meta.uid() == 0;
        let wrong = match foreign(&meta) {
            // Parent folders may belong to root. In a world-writable one such as /tmp, the sticky
            // bit protects this user's files.
            Some(OTHER_OWNER) if above > 0 && root_owns && meta.mode() & 0o022 == 0 => None,
            Some(_) if above > 0 && root_owns && meta.mode() & 0o1000 != 0 => None,
            wrong => wrong,
        };
        if let Some(why) = wrong {
            return Ok(Err((path.to_owned(), why)));
        }
    }
    Ok(Ok(()))
}

/// Returns the reason why another user could have written a file or folder.
pub(crate) fn foreign(meta: &Metadata) -> Option<&'static str> {
    if meta.uid() != rustix::process::geteuid().as_raw() {
        Some(OTHER_OWNER)
    } else if meta.mode() & 0o022 != 0 {
        Some("others may write to it")
    } else {
        None
    }
}
