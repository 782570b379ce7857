//! Fills the new build folder, and replaces the old one atomically.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use gleaner_base::PlainFile;
use gleaner_lambda::layout::{BUILD_MAX, FILES_MAX};
use gleaner_lambda::{BuildDir, Manifest};

use super::error::{BuildError, failed};
use crate::remove_folder;

/// An unfinished build, in a folder beside the old one. The folder is hidden, so that its files do
/// not count as sources if this process is killed. Dropping it before [`finish`](Self::finish)
/// removes it.
pub(super) struct PartialBuild {
    dir: PathBuf,
    path: PathBuf,
    built: Built,
}

/// Number and size of the files in a build.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub(super) struct Built {
    pub(super) files: u64,
    pub(super) bytes: u64,
}

impl PartialBuild {
    /// Creates an empty build of the lambda in `dir`, and removes the remains of a killed one.
    pub(super) fn begin(dir: &Path) -> Result<PartialBuild, BuildError> {
        let path = dir.join(".build.partial");
        remove(&path)?;
        fs::create_dir(&path).map_err(failed("create", &path))?;
        Ok(PartialBuild { dir: dir.to_owned(), path, built: Built::default() })
    }

    /// Copies the `opened` file `from` to the path `to` in the build.
    pub(super) fn add(
        &mut self,
        from: &Path,
        opened: io::Result<PlainFile>,
        to: &Path,
    ) -> Result<(), BuildError> {
        let file = opened.map_err(failed("copy", from))?;
        // Checked before the copy fills the disk.
        self.count(file.length())?;
        let to = self.path.join(to);
        if let Some(folder) = to.parent() {
            fs::create_dir_all(folder).map_err(failed("create", folder))?;
        }
        let created = File::options().write(true).create_new(true).mode(file.mode()).open(&to);
        let mut copy = created.map_err(failed("create", &to))?;
        file.copy_to(&mut copy).map_err(failed("copy", from))
    }

    /// Returns its folder. What is written there by others must be [counted](Self::count).
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn count(&mut self, bytes: u64) -> Result<(), BuildError> {
        self.built.files += 1;
        self.built.bytes = self.built.bytes.saturating_add(bytes);
        let is_within =
            self.built.files <= FILES_MAX as u64 && self.built.bytes <= BUILD_MAX.bytes();
        if is_within { Ok(()) } else { Err(BuildError::TooMuch) }
    }

    /// Adds the manifest and replaces the old build. `started`, the time when the first source was
    /// read, becomes the time of the manifest, which is the age of a build.
    pub(super) fn finish(mut self, started: SystemTime) -> Result<Built, BuildError> {
        let text = Manifest::read(&self.dir).map_err(BuildError::Manifest)?;
        self.count(text.len() as u64)?;
        let manifest = self.path.join("lambda.toml");
        let write = || -> io::Result<()> {
            let mut file = File::create_new(&manifest)?;
            file.write_all(text.as_bytes())?;
            file.set_modified(started)
        };
        write().map_err(failed("write", &manifest))?;
        self.swap()?;
        Ok(self.built)
    }

    fn swap(&self) -> Result<(), BuildError> {
        let build = BuildDir::of(&self.dir);
        let old = self.dir.join(".build.old");
        remove(&old)?;
        let had_one = match fs::rename(build.path(), &old) {
            Ok(()) => true,
            Err(error) if error.kind() == io::ErrorKind::NotFound => false,
            Err(error) => return Err(failed("replace", build.path())(error)),
        };
        if let Err(error) = fs::rename(&self.path, build.path()) {
            if had_one {
                // Restores the old build. If that fails too, the first error matters more.
                let _ = fs::rename(&old, build.path());
            }
            return Err(failed("write", build.path())(error));
        }
        remove(&old)
    }
}

impl Drop for PartialBuild {
    fn drop(&mut self) {
        // The folder is gone after `finish`. After a failure, that failure is reported.
        let _ = fs::remove_dir_all(&self.path);
    }
}

fn remove(folder: &Path) -> Result<(), BuildError> {
    remove_folder(folder).map_err(failed("remove", folder))
}
