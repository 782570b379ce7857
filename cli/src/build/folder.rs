//! The build folder while it is made, and the moment in which it takes the old one's place.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use gleaner_protocol::BuildDir;

use super::error::BuildError;

/// A build in the making, in a hidden folder beside the old one; hidden, because then no file in it counts as a source
/// if we are killed. Dropped before [`finish`](Self::finish), it leaves nothing.
pub(super) struct Partial {
    dir: PathBuf,
    path: PathBuf,
}

/// What a build holds.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Built {
    pub(super) files: u64,
    pub(super) bytes: u64,
}

impl Partial {
    /// An empty build of the lambda in `dir`.
    pub(super) fn begin(dir: &Path) -> Result<Partial, BuildError> {
        let path = dir.join(".build.partial");
        remove(&path)?;
        fs::create_dir(&path).map_err(failed("create", &path))?;
        Ok(Partial { dir: dir.to_owned(), path })
    }

    /// Copies the file `from` to `to`, relative to the build.
    pub(super) fn add(&mut self, from: &Path, to: &Path) -> Result<(), BuildError> {
        let to = self.path.join(to);
        if let Some(folder) = to.parent() {
            fs::create_dir_all(folder).map_err(failed("create", folder))?;
        }
        fs::copy(from, &to).map(drop).map_err(failed("copy", from))
    }

    /// Adds the manifest, by whose time the age of a build is told, and puts the build into its place. `started` is
    /// when its first source was read.
    pub(super) fn finish(self, started: SystemTime) -> Result<Built, BuildError> {
        let source = self.dir.join("lambda.toml");
        let text = fs::read(&source).map_err(failed("read", &source))?;
        let manifest = self.path.join("lambda.toml");
        let write = |text: &[u8]| -> io::Result<()> {
            let mut file = File::create(&manifest)?;
            file.write_all(text)?;
            file.set_modified(started)
        };
        write(&text).map_err(failed("write", &manifest))?;
        let built = contents(&self.path).map_err(failed("list", &self.path))?;
        self.swap()?;
        Ok(built)
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
                // As it was; if even that fails, the first error tells more.
                let _ = fs::rename(&old, build.path());
            }
            return Err(failed("write", build.path())(error));
        }
        remove(&old)
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        // Gone already after `finish`; after a failure, that failure is what the user has to hear of.
        let _ = fs::remove_dir_all(&self.path);
    }
}

fn remove(folder: &Path) -> Result<(), BuildError> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(failed("remove", folder)(error)),
        _ => Ok(()),
    }
}

fn contents(folder: &Path) -> io::Result<Built> {
    let mut built = Built { files: 0, bytes: 0 };
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let data = entry.metadata()?;
        let inside = match data.is_dir() {
            true => contents(&entry.path())?,
            false => Built { files: 1, bytes: data.len() },
        };
        built.files += inside.files;
        built.bytes += inside.bytes;
    }
    Ok(built)
}

fn failed(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> BuildError {
    let path = path.to_owned();
    move |source| BuildError::File { action, path, source }
}
