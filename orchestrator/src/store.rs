//! Revisions on the disk, under their digests, and files that were sent and belong to none yet.
//!
//! A revision is a folder with `build/` and its envelope, `revision.json`. It appears under its
//! name only when it is complete, checked and durable, and is never changed afterwards; of one with
//! wheels, `gleaner-wheels` keeps the environment beside the build.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fs::{self, File, Permissions};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use gleaner_base::{Exit, Failure, PlainFile, hex, safe_file, sync_folder};
use gleaner_lambda::BuildDir;
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::Sha256;
use gleaner_protocol::vehicle_api::MissingObject;
use gleaner_trust::{Payload, Revision, Trusted, check_files, revision_of_digest};
use sha2::Digest;

use crate::layout::VehicleFolders;

/// Time for which a download that was interrupted can go on.
const PARTIAL_AGE: Duration = Duration::from_secs(7 * 86_400);

/// Name of the envelope in the folder of a revision.
const ENVELOPE: &str = "revision.json";

/// The path of each file of each revision, by its digest.
pub(crate) type KnownFiles = BTreeMap<String, PathBuf>;

#[derive(Debug, Clone)]
pub(crate) struct RevisionStore {
    objects: PathBuf,
    revisions: PathBuf,
}

impl RevisionStore {
    /// Opens the store, and removes what an earlier process left unfinished.
    pub(crate) fn open(layout: &VehicleFolders) -> Result<Self, Failure> {
        let store = Self { objects: layout.objects(), revisions: layout.revisions() };
        let unfinished = [(&store.objects, "part"), (&store.revisions, "tmp")];
        for (folder, extension) in unfinished {
            for path in entries(folder)? {
                if path.extension().is_some_and(|it| it == extension) {
                    remove(&path);
                }
            }
        }
        Ok(store)
    }

    /// Returns whether it has revisions.
    pub(crate) fn has_any(&self) -> Result<bool, Failure> {
        Ok(!entries(&self.revisions)?.is_empty())
    }

    /// Returns the folder of a revision, which has its `build/`.
    pub(crate) fn folder(&self, digest: &Sha256) -> PathBuf {
        self.revisions.join(digest.as_str())
    }

    pub(crate) fn envelope_path(&self, digest: &Sha256) -> PathBuf {
        self.folder(digest).join(ENVELOPE)
    }

    pub(crate) fn has(&self, digest: &Sha256) -> bool {
        self.envelope_path(digest).is_file()
    }

    /// Returns whether a revision is stored, and all of its files are as signed.
    pub(crate) fn is_intact(&self, revision: &Trusted<Revision>) -> bool {
        let digest = revision.digest();
        let build = BuildDir::of(self.folder(digest));
        self.has(digest) && check_files(revision.payload(), &build).is_ok()
    }

    /// Reads the envelope of a revision.
    pub(crate) fn envelope(&self, digest: &Sha256) -> io::Result<Vec<u8>> {
        PlainFile::named(&self.envelope_path(digest), Revision::MAX)?.read_whole()
    }

    /// Returns the files of `revision` that neither were sent nor are in a kept revision, which
    /// `known` lists.
    pub(crate) fn missing(&self, revision: &Revision, known: &KnownFiles) -> Vec<MissingObject> {
        let mut missing = BTreeMap::new();
        for file in &revision.files {
            let source = known.get(file.sha256.as_str()).filter(|it| has_digest(it, &file.sha256));
            if source.is_none() && !has_digest(&self.object(&file.sha256), &file.sha256) {
                let sha256 = file.sha256.to_string();
                missing.insert(sha256.clone(), MissingObject { sha256, bytes: file.bytes });
            }
        }
        missing.into_values().collect()
    }

    /// Returns the path of a file that was sent, and that of its parts until it is complete.
    pub(crate) fn object(&self, sha256: &Sha256) -> PathBuf {
        self.objects.join(sha256.as_str())
    }

    /// Makes the revision in `envelope`, which was verified and is not [intact](Self::is_intact),
    /// from the files that were sent and those of other revisions, which `known` lists.
    /// Afterwards it lists its files, too.
    pub(crate) fn add(
        &self,
        digest: &Sha256,
        envelope: &[u8],
        known: &mut KnownFiles,
    ) -> Result<(), Failure> {
        let revision = revision_of_digest(envelope, digest)
            .map_err(|refusal| Failure::because("cannot store a revision", &refusal))?;
        let folder = self.revisions.join(format!("{digest}.tmp"));
        remove(&folder);
        let stored = self.fill(&folder, &revision, envelope, (digest, known));
        if stored.is_err() {
            remove(&folder);
        }
        stored?;
        for file in &revision.files {
            let path = self.folder(digest).join("build").join(file.path.as_path());
            known.insert(file.sha256.to_string(), path);
            // Of a damaged disk: the object would be sent again, and nothing is lost.
            let _ = fs::remove_file(self.object(&file.sha256));
        }
        Ok(())
    }

    fn fill(
        &self,
        folder: &Path,
        revision: &Revision,
        envelope: &[u8],
        (digest, known): (&Sha256, &KnownFiles),
    ) -> Result<(), Failure> {
        let build = folder.join("build");
        let failed = |path: &Path| {
            let action = format!("cannot write `{}`", path.display());
            move |error: io::Error| Failure::caused_by(Exit::Internal, action.clone(), &error)
        };
        let mut folders = BTreeSet::from([folder.to_owned(), build.clone()]);
        fs::create_dir_all(&build).map_err(failed(&build))?;
        for file in &revision.files {
            let path = build.join(file.path.as_path());
            for parent in file.path.as_path().ancestors().skip(1) {
                folders.insert(build.join(parent));
            }
            if let Some(parent) = path.parent() {
                fs::create_dir_all(parent).map_err(failed(parent))?;
            }
            let object = self.object(&file.sha256);
            let source = match known.get(file.sha256.as_str()) {
                Some(known) if !has_digest(&object, &file.sha256) => known,
                _ => &object,
            };
            copy(source, &path).map_err(failed(&path))?;
        }
        let path = folder.join(ENVELOPE);
        safe_file::create(&path)
            .and_then(|mut file| {
                io::Write::write_all(&mut file, envelope)?;
                file.sync_all()
            })
            .map_err(failed(&path))?;
        check_files(revision, &BuildDir::of(folder))
            .map_err(|error| Failure::because("the files of a revision are refused", &error))?;
        // The innermost first.
        for folder in folders.iter().rev() {
            sync_folder(folder).map_err(failed(folder))?;
        }
        let name = self.folder(digest);
        // Of one that the disk has changed: its other files were copied.
        remove(&name);
        fs::rename(folder, &name).map_err(failed(&name))?;
        sync_folder(&self.revisions).map_err(failed(&self.revisions))
    }

    /// Removes all revisions but `kept`, and all files that were sent but `expected`. Returns the
    /// number of revisions that were removed.
    pub(crate) fn collect(
        &self,
        kept: &BTreeSet<Sha256>,
        expected: &BTreeSet<Sha256>,
    ) -> Result<usize, Failure> {
        let is_of = |set: &BTreeSet<Sha256>, path: &Path| {
            let name = path.file_name().and_then(|name| name.to_str());
            name.is_some_and(|name| set.iter().any(|digest| digest.as_str() == name))
        };
        for path in entries(&self.objects)? {
            let is_kept = match path.extension().and_then(OsStr::to_str) {
                // It is being received.
                Some("part") => true,
                // A download goes on there, also after a restart, when nothing is expected yet.
                Some("partial") => is_younger(&path, PARTIAL_AGE),
                _ => is_of(expected, &path),
            };
            if !is_kept {
                remove(&path);
            }
        }
        let unused: Vec<_> =
            entries(&self.revisions)?.into_iter().filter(|path| !is_of(kept, path)).collect();
        unused.iter().for_each(|path| remove(path));
        Ok(unused.len())
    }

    pub(crate) fn known_files(&self) -> KnownFiles {
        let mut known = BTreeMap::new();
        for folder in entries(&self.revisions).unwrap_or_default() {
            let digest =
                folder.file_name().and_then(|name| name.to_str()).map(str::parse::<Sha256>);
            let Some(Ok(digest)) = digest else { continue };
            let envelope = self.envelope(&digest).ok();
            let revision = envelope.and_then(|it| revision_of_digest(&it, &digest).ok());
            for file in revision.into_iter().flat_map(|revision| revision.files) {
                let path = folder.join("build").join(file.path.as_path());
                known.insert(file.sha256.to_string(), path);
            }
        }
        known
    }
}

/// Copies a file durably, as read-only.
fn copy(from: &Path, to: &Path) -> io::Result<()> {
    let source = PlainFile::named(from, FILE_MAX)?;
    let mut target = safe_file::create(to)?;
    source.copy_to(&mut target)?;
    target.set_permissions(Permissions::from_mode(0o400))?;
    target.sync_all()
}

pub(crate) fn entries(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let listed = fs::read_dir(folder)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect::<io::Result<_>>());
    listed.map_err(|error| {
        let action = format!("cannot list `{}`", folder.display());
        Failure::caused_by(Exit::Internal, action, &error)
    })
}

/// Removes a file or a folder, as far as that is possible: it is tried again at the next start.
pub(crate) fn remove(path: &Path) {
    let removed = match path.symlink_metadata() {
        Ok(found) if found.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(_) => return,
    };
    if let Err(error) = removed {
        tracing::warn!(path = %path.display(), %error, "cannot delete; retried at the next start");
    }
}

/// Returns whether a file was changed within this time. After a jump of the clock, it was not.
fn is_younger(path: &Path, age: Duration) -> bool {
    let changed = path.symlink_metadata().and_then(|found| found.modified());
    changed.is_ok_and(|changed| changed.elapsed().is_ok_and(|elapsed| elapsed < age))
}

/// Begins a file that is being received.
pub(crate) fn begin_object(path: &Path) -> io::Result<(File, PathBuf)> {
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let part = path.with_extension(format!("{number}.part"));
    Ok((safe_file::create(&part)?, part))
}

/// Returns whether a file exists and has this digest.
fn has_digest(path: &Path, sha256: &Sha256) -> bool {
    let Ok(file) = PlainFile::named(path, FILE_MAX) else { return false };
    let (mut file, mut digest) = (file.into_file(), sha2::Sha256::new());
    io::copy(&mut file, &mut digest).is_ok() && hex(&digest.finalize()) == sha256.as_str()
}
