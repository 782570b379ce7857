//! The store of what tools make of files: native code of components, and engines of models. It is a
//! folder of this user.
//!
//! - `derived`: an entry, behind a digest that binds it to everything it was made from.
//! - `engine`: entries with an engine of TensorRT.
//! - `write`: writes an entry as a whole, or not at all. `prune`: bounds the size of the store.
//! - `trust`: checks that only this user can write to a file and the folders above it.
//!
//! An entry can always be made again: the store may remove any. It never runs a tool.

mod derived;
mod engine;
mod prune;
mod trust;
mod write;

use std::fmt;
use std::fs;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Explain};

pub use derived::{DerivedEntry, DerivedKey, StoreLookup};
pub use engine::BuiltEngine;
pub use prune::STORE_BYTES;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DerivedKind {
    NativeCode,
    /// Engine of TensorRT, built of a model.
    Engine,
}

impl DerivedKind {
    const ALL: [DerivedKind; 2] = [DerivedKind::NativeCode, DerivedKind::Engine];

    pub const fn max_bytes(self) -> usize {
        match self {
            DerivedKind::NativeCode => 256 << 20,
            // An engine is about as large as its model. It is held in memory twice to load it.
            DerivedKind::Engine => 512 << 20,
        }
    }

    const fn extension(self) -> &'static str {
        match self {
            DerivedKind::NativeCode => "cwasm",
            DerivedKind::Engine => "engine",
        }
    }
}

impl fmt::Display for DerivedKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            DerivedKind::NativeCode => "native code",
            DerivedKind::Engine => "an engine of TensorRT",
        })
    }
}

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("cannot write to the store of compiled files, `{}`", path.display())]
    Folder { path: PathBuf, source: io::Error },
    #[error("cannot write {kind} to `{}`", path.display())]
    Write { kind: DerivedKind, path: PathBuf, source: io::Error },
    #[error("cannot read {kind} in `{}`", path.display())]
    Read { kind: DerivedKind, path: PathBuf, source: io::Error },
    #[error("{kind} in `{}` is not loaded: {why}", path.display())]
    Untrusted { kind: DerivedKind, path: PathBuf, why: String },
}

impl Explain for StoreError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Folder { .. } | Self::Write { .. } => {
                "make the folder writable, or set XDG_CACHE_HOME to one that is".to_owned()
            }
            Self::Read { path, .. } | Self::Untrusted { path, .. } if is_entry(path) => {
                format!("delete it, it will be made again: rm -r '{}'", path.display())
            }
            // A folder of the user, with more in it than the store.
            Self::Read { .. } => "set XDG_CACHE_HOME to a folder that can be read".to_owned(),
            Self::Untrusted { path, .. } => format!(
                "let only yourself write to it: chmod go-w '{}'; or set XDG_CACHE_HOME to a folder \
                 of yours",
                path.display()
            ),
        })
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Untrusted { .. } => Exit::Denied,
            Self::Folder { .. } | Self::Write { .. } | Self::Read { .. } => Exit::Internal,
        }
    }
}

fn is_entry(path: &Path) -> bool {
    let extension = path.extension().and_then(|extension| extension.to_str());
    DerivedKind::ALL.iter().any(|kind| Some(kind.extension()) == extension)
}

/// Creates the folder of a store, and those above it that are missing, accessible to this user
/// only.
///
/// # Errors
///
/// [`StoreError::Folder`].
pub fn make_store(folder: &Path) -> Result<(), StoreError> {
    let failed = |source| StoreError::Folder { path: folder.to_owned(), source };
    fs::DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(failed)
}
