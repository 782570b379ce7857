//! Notices that the programs were replaced while this one runs, as an upgrade does.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use gleaner_base::programs::InstalledPrograms;

pub(crate) struct Installation {
    /// Path of this program, and its file; `None` if unknown.
    program: Option<(PathBuf, FileId)>,
}

type FileId = (u64, u64);

impl Installation {
    /// Returns the installation `parts`, to which the running program belongs.
    pub(crate) fn of(parts: &InstalledPrograms) -> Self {
        // Not the path that the kernel gives: the installation may be behind a link, which moves.
        let path = parts.program("gleaner-supervisor").ok();
        Self { program: path.zip(id(Path::new("/proc/self/exe"))) }
    }

    /// Returns whether another file has taken the place of this program. Each upgrade replaces all
    /// programs; one that is missing is none that could be started instead.
    pub(crate) fn is_replaced(&self) -> bool {
        let Some((path, file)) = &self.program else { return false };
        id(path).is_some_and(|found| found != *file)
    }
}

fn id(path: &Path) -> Option<FileId> {
    let meta = fs::metadata(path).ok()?;
    Some((meta.dev(), meta.ino()))
}
