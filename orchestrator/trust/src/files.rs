//! Digests of the files of a build folder, and their comparison with a revision.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Explain, NotPlain, PlainFile};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::{NameError, RelativePath};
use gleaner_lambda::{BuildDir, LayoutError};
use sha2::{Digest, Sha256};

use crate::envelope::digest_text;
use crate::{Refusal, Revision, RevisionFile};

/// The reason why the files of a build are refused or cannot be read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum FileDigestError {
    #[error(transparent)]
    Layout(#[from] LayoutError),
    #[error("cannot read `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("a revision cannot name the file `{}`", path.display())]
    Name { path: PathBuf, source: Option<NameError> },
    #[error(transparent)]
    Refused(#[from] Refusal),
}

impl Explain for FileDigestError {
    fn help(&self) -> Option<String> {
        match self {
            Self::Layout(error) => error.help(),
            Self::Read { source, .. } => NotPlain::of(source).map(NotPlain::help),
            Self::Name { .. } => Some(
                "rename it: UTF-8, at most 255 bytes with its folders, no control characters"
                    .to_owned(),
            ),
            Self::Refused(refusal) => refusal.help(),
        }
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Layout(error) => error.exit(),
            Self::Read { source, .. } if NotPlain::of(source).is_none() => Exit::Internal,
            Self::Read { .. } | Self::Name { .. } => Exit::Usage,
            Self::Refused(refusal) => refusal.exit(),
        }
    }
}

/// Returns all files of `build`, sorted by path.
pub(crate) fn digests(build: &BuildDir) -> Result<Vec<RevisionFile>, FileDigestError> {
    let files = build.files()?;
    let mut files = files.iter().map(|path| digest(build, path)).collect::<Result<Vec<_>, _>>()?;
    // As text: paths are compared part by part.
    files.sort_by(|a, b| a.path.as_str().cmp(b.path.as_str()));
    Ok(files)
}

/// Checks that `build` has the files of `revision` and no others: their lengths, then their
/// digests. No link out of the folder is followed.
///
/// # Errors
///
/// [`FileDigestError::Refused`] with the first difference; those of reading the files.
pub fn check_files(revision: &Revision, build: &BuildDir) -> Result<(), FileDigestError> {
    let mut found = BTreeSet::new();
    for path in build.files()? {
        found.insert(name_of(&path)?.to_string());
    }
    let signed: BTreeSet<_> = revision.files.iter().map(|file| file.path.to_string()).collect();
    if let Some(path) = signed.difference(&found).next() {
        return Err(Refusal::MissingFile { path: path.clone() }.into());
    }
    if let Some(path) = found.difference(&signed).next() {
        return Err(Refusal::ExtraFile { path: path.clone() }.into());
    }
    for signed in &revision.files {
        let path = signed.path.to_string();
        let length = open(build, signed.path.as_path())?.length();
        if length != signed.bytes {
            return Err(Refusal::Length { path, signed: signed.bytes, found: length }.into());
        }
    }
    for signed in &revision.files {
        let found = digest(build, signed.path.as_path())?.sha256;
        if found != signed.sha256 {
            let (path, signed) = (signed.path.to_string(), signed.sha256.clone());
            return Err(Refusal::Digest { path, signed, found }.into());
        }
    }
    Ok(())
}

fn digest(build: &BuildDir, path: &Path) -> Result<RevisionFile, FileDigestError> {
    let name = name_of(path)?;
    let mut file = open(build, path)?;
    let mut digest = Sha256::new();
    let copied = io::copy(&mut file, &mut digest);
    let bytes =
        copied.map_err(|source| FileDigestError::Read { path: build.path().join(path), source })?;
    Ok(RevisionFile { path: name, bytes, sha256: digest_text(&digest.finalize()) })
}

fn open(build: &BuildDir, path: &Path) -> Result<PlainFile, FileDigestError> {
    PlainFile::inside(build.path(), path, FILE_MAX)
        .map_err(|source| FileDigestError::Read { path: build.path().join(path), source })
}

fn name_of(path: &Path) -> Result<RelativePath, FileDigestError> {
    let failed = |source| FileDigestError::Name { path: path.to_owned(), source };
    path.to_str().ok_or_else(|| failed(None))?.parse().map_err(|error| failed(Some(error)))
}
