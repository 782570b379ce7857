//! Digests of the files of a build folder, and their comparison with a revision.

use std::collections::BTreeSet;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Explain, NotPlain, PlainFile};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::bounds::MANIFEST_MAX;
use gleaner_lambda::manifest::{NameError, RelativePath};
use gleaner_lambda::{BuildDir, LayoutError, Manifest, ManifestError};
use sha2::{Digest, Sha256};

use crate::digest::digest_text;
use crate::{Refusal, Revision, RevisionFile, SecretKey};

/// Path of the manifest in a build folder.
const MANIFEST: &str = "lambda.toml";

/// The reason why the files of a build are refused or cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum FileDigestError {
    #[error(transparent)]
    Layout(#[from] LayoutError),
    #[error("cannot read `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("a revision cannot name the file `{}`", path.display())]
    Name { path: PathBuf, source: Option<NameError> },
    #[error("`{}` is a secret key, and the files of a build are distributed", path.display())]
    SecretKey { path: PathBuf },
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
            Self::SecretKey { .. } => Some(
                "remove it from the build and its sources; if others may have it, make a new key"
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
            Self::SecretKey { .. } => Exit::Denied,
            Self::Refused(refusal) => refusal.exit(),
        }
    }
}

/// Returns all files of `build`, sorted by path. A secret key among them is refused.
pub(crate) fn digests(build: &BuildDir) -> Result<Vec<RevisionFile>, FileDigestError> {
    let files = build.files()?;
    let digest = |path: &PathBuf| {
        let (file, start) = digest(build, path)?;
        match file.bytes == start.len() as u64 && SecretKey::is_key(&start) {
            true => Err(FileDigestError::SecretKey { path: build.path().join(path) }),
            false => Ok(file),
        }
    };
    let mut files = files.iter().map(digest).collect::<Result<Vec<_>, _>>()?;
    // As text: paths are compared part by part.
    files.sort_by(|a, b| a.path.as_str().cmp(b.path.as_str()));
    Ok(files)
}

/// Checks that `build` has the files of `revision` and no others: their lengths, then their
/// digests. No link out of the folder is followed. `lambda.toml`, whose digest is checked on the
/// bytes that are parsed, must have the name, version and kind of the revision.
///
/// This check and loading are separate: the caller must first copy the files to a folder to which
/// no other program writes, check them there, and load them from there. In any other folder, the
/// files that are loaded need not be those that were checked.
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
    if !signed.contains(MANIFEST) {
        return Err(Refusal::MissingFile { path: MANIFEST.to_owned() }.into());
    }
    for signed in &revision.files {
        let path = signed.path.to_string();
        let length = open(build, signed.path.as_path())?.length();
        if length != signed.bytes {
            return Err(Refusal::Length { path, signed: signed.bytes, found: length }.into());
        }
    }
    for signed in &revision.files {
        let (file, start) = digest(build, signed.path.as_path())?;
        if file.sha256 != signed.sha256 {
            let (path, signed) = (signed.path.to_string(), signed.sha256.clone());
            return Err(Refusal::Digest { path, signed, found: file.sha256 }.into());
        }
        if signed.path.as_str() == MANIFEST {
            check_manifest(revision, build.manifest_path(), file.bytes, start)?;
        }
    }
    Ok(())
}

/// Checks the manifest of `bytes` bytes that begins with `text` and is stored at `path`.
fn check_manifest(
    revision: &Revision,
    path: PathBuf,
    bytes: u64,
    text: Vec<u8>,
) -> Result<(), FileDigestError> {
    if bytes > MANIFEST_MAX.bytes() {
        let error = ManifestError::TooLong { path, limit: MANIFEST_MAX };
        return Err(LayoutError::Manifest(error).into());
    }
    let text = String::from_utf8(text).map_err(|error| {
        let source = io::Error::new(io::ErrorKind::InvalidData, error.utf8_error());
        LayoutError::Manifest(ManifestError::Read { path: path.clone(), source })
    })?;
    let found = Manifest::parse(&text, path).map_err(LayoutError::Manifest)?.lambda;
    for (what, signed, found) in [
        ("name", revision.name.as_str(), found.name.as_str()),
        ("version", revision.version.as_str(), found.version.as_str()),
        ("kind", revision.kind.as_str(), found.kind.as_str()),
    ] {
        if signed != found {
            let (signed, found) = (signed.to_owned(), found.to_owned());
            return Err(Refusal::OtherManifest { what, signed, found }.into());
        }
    }
    Ok(())
}

/// Returns the digest of a file, and the start of the same bytes, up to the length of a manifest.
fn digest(build: &BuildDir, path: &Path) -> Result<(RevisionFile, Vec<u8>), FileDigestError> {
    let name = name_of(path)?;
    let mut file = open(build, path)?;
    let (mut digest, mut start) = (Sha256::new(), Vec::new());
    let read = (&mut file).take(MANIFEST_MAX.bytes()).read_to_end(&mut start).and_then(|read| {
        digest.update(&start);
        io::copy(&mut file, &mut digest).map(|rest| read as u64 + rest)
    });
    let bytes =
        read.map_err(|source| FileDigestError::Read { path: build.path().join(path), source })?;
    Ok((RevisionFile { path: name, bytes, sha256: digest_text(&digest.finalize()) }, start))
}

fn open(build: &BuildDir, path: &Path) -> Result<PlainFile, FileDigestError> {
    PlainFile::inside(build.path(), path, FILE_MAX)
        .map_err(|source| FileDigestError::Read { path: build.path().join(path), source })
}

fn name_of(path: &Path) -> Result<RelativePath, FileDigestError> {
    let failed = |source| FileDigestError::Name { path: path.to_owned(), source };
    path.to_str().ok_or_else(|| failed(None))?.parse().map_err(|error| failed(Some(error)))
}
