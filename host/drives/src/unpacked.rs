//! Packed files of a drive whose content is open.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tempfile::TempPath;

#[derive(Clone, Debug)]
pub struct Unpacked {
    /// The packed file, named as in the drive.
    pub(super) path: PathBuf,
    pub(super) content: Arc<File>,
    /// The reason why the content is incomplete, if it is.
    pub(super) broken: Option<String>,
    pub(super) name: Option<ContentName>,
}

#[derive(Clone, Debug)]
pub enum ContentName {
    /// Removed with the last clone.
    Own(Arc<TempPath>),
    /// Created and removed by the process that unpacked the file.
    Given(PathBuf),
}

impl AsRef<Path> for ContentName {
    fn as_ref(&self) -> &Path {
        match self {
            Self::Own(name) => name,
            Self::Given(name) => name,
        }
    }
}

impl Unpacked {
    /// Opens the content of the packed file `path`, which another process unpacked and named `name`
    /// temporarily; `broken` is the reason if it is incomplete.
    ///
    /// # Errors
    ///
    /// Errors of opening `name`.
    pub fn named(path: PathBuf, name: PathBuf, broken: Option<String>) -> io::Result<Self> {
        Ok(Self {
            path,
            content: Arc::new(File::open(&name)?),
            broken,
            name: Some(ContentName::Given(name)),
        })
    }

    /// Returns the name that another process gave the content, if one did.
    pub fn given_name(&self) -> Option<&Path> {
        match &self.name {
            Some(ContentName::Given(name)) => Some(name),
            _ => None,
        }
    }

    /// Returns the packed file, and the reason if its content is incomplete.
    pub fn parts(&self) -> (&Path, Option<&str>) {
        (&self.path, self.broken.as_deref())
    }
}
