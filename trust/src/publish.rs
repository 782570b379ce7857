//! Publishing: signs the build of a lambda, and writes the revision beside it.

use std::fs::{File, TryLockError};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use gleaner_base::text::shell_word;
use gleaner_base::{Exit, Explain, NotPlain, PlainFile, write_atomically};
use gleaner_lambda::manifest::{LambdaName, Sha256};
use gleaner_lambda::{BuildDir, LayoutError, Manifest, ManifestError};
use rustix::fs::OFlags;

use crate::envelope::Unverified;
use crate::files::digests;
use crate::{
    COUNTER_MAX, FileDigestError, Payload, Refusal, Revision, SecretKey, check_files, seal,
};

/// Pause between two attempts to lock a folder, and their number: half a minute in all. Another
/// publish takes less, a build can take more, and any user who can open the folder can hold its
/// lock for ever.
const LOCK_PAUSE: Duration = Duration::from_millis(50);
const LOCK_ATTEMPTS: u32 = 600;

#[derive(Debug)]
pub struct Release<'a> {
    pub lambda: &'a Path,
    /// The file to write.
    pub out: &'a Path,
    /// Number of the release; without one, the next after that of the revision in `out`, which
    /// must be signed by the same key.
    pub release: Option<u64>,
    /// The time, in seconds since 1970.
    pub created: u64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Published {
    pub revision: Revision,
    /// Its digest, by which deployments name it.
    pub digest: Sha256,
    /// True if the file had this build already, signed by this key: it is as it was.
    pub unchanged: bool,
}

/// Signs the build of a lambda with `key`. The file is the former one or the new one at any time.
///
/// # Errors
///
/// [`ReleaseError`].
pub fn publish(release: &Release<'_>, key: &SecretKey) -> Result<Published, ReleaseError> {
    let Release { lambda, out, created, .. } = *release;
    let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    // First without the lock, which needs the folder, and again below it.
    BuildDir::check_fresh(lambda)?;
    let _locks = lock(lambda, folder)?;
    let build = BuildDir::check_fresh(lambda)?;
    refuse_inside(out, folder, &build)?;
    let manifest = Manifest::load(build.path())?.lambda;
    let mut revision = Revision {
        name: manifest.name,
        version: manifest.version,
        kind: manifest.kind,
        release: 1,
        created,
        files: digests(&build)?,
    };
    let existing = read_existing(out, key)?;
    if let Some((other, ..)) = existing.as_ref().filter(|(it, ..)| it.name != revision.name) {
        let (found, lambda) = (other.name.clone(), revision.name);
        return Err(ReleaseError::OtherLambda { path: out.to_owned(), found, lambda });
    }
    revision.release = match (existing, release.release) {
        (None, asked) => asked.unwrap_or(1),
        // Any user may have chosen the number in it.
        (Some((_, _, false)), asked) => {
            asked.ok_or_else(|| ReleaseError::NotOurs { path: out.to_owned() })?
        }
        (Some((existing, digest, true)), asked) => {
            let former = existing.release;
            let is_same = existing
                == Revision { created: existing.created, release: former, ..revision.clone() };
            let asked = asked.unwrap_or(former + u64::from(!is_same));
            if is_same && asked == former {
                return Ok(Published { revision: existing, digest, unchanged: true });
            }
            if former == COUNTER_MAX {
                return Err(ReleaseError::LastRelease { path: out.to_owned() });
            }
            if asked <= former {
                let path = out.to_owned();
                return Err(ReleaseError::Counter { path, asked, existing: former });
            }
            asked
        }
    };
    if !(1..=COUNTER_MAX).contains(&revision.release) {
        return Err(ReleaseError::CounterRange { release: revision.release });
    }
    check_files(&revision, &build)?;
    let envelope = seal(&revision, &[key])?;
    let digest = Unverified::<Revision>::parse(&envelope)?.digest();
    write_atomically(out, &envelope)
        .map_err(|source| ReleaseError::Write { path: out.to_owned(), source })?;
    Ok(Published { revision, digest, unchanged: false })
}

/// Locks the lambda's folder, as `gleaner build` does, and that of the revision, in one order for
/// all processes.
fn lock(lambda: &Path, out: &Path) -> Result<Vec<File>, ReleaseError> {
    let failed = |path: &Path, source| ReleaseError::Lock { path: path.to_owned(), source };
    let resolved = |path: &Path| path.canonicalize().map_err(|source| failed(path, source));
    let mut folders = vec![resolved(lambda)?, resolved(out)?];
    folders.sort();
    folders.dedup();
    folders.iter().map(|folder| lock_folder(folder, LOCK_ATTEMPTS)).collect()
}

fn lock_folder(path: &Path, attempts: u32) -> Result<File, ReleaseError> {
    let failed = |source| ReleaseError::Lock { path: path.to_owned(), source };
    let flags = OFlags::DIRECTORY.bits().cast_signed();
    let folder = File::options().read(true).custom_flags(flags).open(path).map_err(failed)?;
    for _ in 0..attempts {
        match folder.try_lock() {
            Ok(()) => return Ok(folder),
            Err(TryLockError::WouldBlock) => thread::sleep(LOCK_PAUSE),
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
    }
    Err(ReleaseError::Busy { path: path.to_owned() })
}

/// Refuses a revision within the build: it would be a file that it does not list.
fn refuse_inside(out: &Path, folder: &Path, build: &BuildDir) -> Result<(), ReleaseError> {
    let (Ok(folder), Ok(inside)) = (folder.canonicalize(), build.path().canonicalize()) else {
        return Ok(());
    };
    match folder.starts_with(inside) {
        true => Err(ReleaseError::Inside { path: out.to_owned() }),
        false => Ok(()),
    }
}

/// Returns the revision in `out` with its digest, if there is one, and whether `key` signed it.
fn read_existing(
    out: &Path,
    key: &SecretKey,
) -> Result<Option<(Revision, Sha256, bool)>, ReleaseError> {
    let read = PlainFile::result(out, Revision::MAX).and_then(PlainFile::read_whole);
    let bytes = match read {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        read => read.map_err(|source| ReleaseError::Read { path: out.to_owned(), source })?,
    };
    let parse = || {
        let envelope = Unverified::<Revision>::parse(&bytes)?;
        let is_ours = envelope.signers([&key.public()]).is_ok();
        Ok((envelope.payload()?, envelope.digest(), is_ours))
    };
    parse().map(Some).map_err(|source| ReleaseError::NoRevision { path: out.to_owned(), source })
}

#[derive(Debug, thiserror::Error)]
pub enum ReleaseError {
    #[error(transparent)]
    Layout(#[from] LayoutError),
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    #[error(transparent)]
    Files(#[from] FileDigestError),
    #[error("cannot sign the revision")]
    Seal(#[from] Refusal),
    #[error("cannot lock folder `{}`", path.display())]
    Lock { path: PathBuf, source: io::Error },
    #[error("another process has locked folder `{}`", path.display())]
    Busy { path: PathBuf },
    #[error("`{}` is in the build folder, whose files the revision lists", path.display())]
    Inside { path: PathBuf },
    #[error("cannot read `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("`{}` exists and is not a revision", path.display())]
    NoRevision { path: PathBuf, source: Refusal },
    #[error("`{}` is a revision of lambda `{found}`, not of `{lambda}`", path.display())]
    OtherLambda { path: PathBuf, found: LambdaName, lambda: LambdaName },
    #[error("`{}` is not signed by this key", path.display())]
    NotOurs { path: PathBuf },
    #[error("`{}` has release {COUNTER_MAX}, and no number follows it", path.display())]
    LastRelease { path: PathBuf },
    #[error("release {asked} cannot replace release {existing} in `{}`", path.display())]
    Counter { path: PathBuf, asked: u64, existing: u64 },
    #[error("release {release} is not from 1 to {COUNTER_MAX}")]
    CounterRange { release: u64 },
    #[error("cannot write `{}`", path.display())]
    Write { path: PathBuf, source: io::Error },
}

impl Explain for ReleaseError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Layout(error) => return error.help(),
            Self::Manifest(error) => return error.help(),
            Self::Files(error) => return error.help(),
            Self::Seal(_) => return None,
            Self::Lock { .. } => {
                "check that the folder exists and lies on a file system with locks".to_owned()
            }
            Self::Busy { .. } => {
                "wait until `gleaner build` or `gleaner publish` ends there; if another user holds \
                 the lock, publish from and to folders that only you can open"
                    .to_owned()
            }
            Self::Inside { .. } => "name a file in another folder: --out FILE".to_owned(),
            Self::Read { source, .. } => match NotPlain::of(source) {
                Some(reason) => reason.help(),
                None => "name another file: --out FILE".to_owned(),
            },
            Self::NoRevision { path, .. } => {
                format!("name another file: --out FILE; or run `rm {}`", shell_word(path))
            }
            Self::OtherLambda { .. } => {
                "name another file: --out FILE; each lambda has its own".to_owned()
            }
            Self::NotOurs { .. } => {
                "give `--release N`, with N above every release of this lambda so far".to_owned()
            }
            Self::LastRelease { path } => format!(
                "if no vehicle has accepted it, run `rm {}` and publish again; otherwise the \
                 lambda needs a new name",
                shell_word(path)
            ),
            Self::Counter { existing, .. } => {
                format!("omit --release for the next one, or give one above {existing}")
            }
            Self::CounterRange { .. } => "give a number in this range: --release N".to_owned(),
            Self::Write { .. } => {
                "check that the folder is writable, and that its disk has room".to_owned()
            }
        })
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Layout(error) => error.exit(),
            Self::Manifest(error) => error.exit(),
            Self::Files(error) => error.exit(),
            Self::Lock { source, .. } | Self::Read { source, .. }
                if NotPlain::of(source).is_none() && source.kind() != io::ErrorKind::NotFound =>
            {
                Exit::Internal
            }
            Self::Busy { .. } | Self::Write { .. } => Exit::Internal,
            _ => Exit::Usage,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_that_another_process_keeps_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        let held = lock_folder(folder.path(), 1).unwrap();
        let error = lock_folder(folder.path(), 3).unwrap_err();
        assert!(matches!(error, ReleaseError::Busy { .. }), "{error}");
        assert!(error.help().is_some_and(|help| help.contains("gleaner build")));
        drop(held);
        lock_folder(folder.path(), 1).unwrap();
    }
}
