//! The output folder of a recorder.

use std::collections::HashSet;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use gleaner_base::safe_file;
use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use gleaner_trust::ClipSigner;
use tracing::warn;

use super::clip_dir::{CLIPS, ClipDir, PART};
use super::list::{ClipList, ListedClip};
use super::losses::LossList;
use super::recover::Recovery;
use super::retention::Retention;
use super::unfinished::UnfinishedClip;
use super::{ClipHeader, replaced};
use crate::error::RecordError;

/// The listed clips of a [`RecordingFolder`], which stays locked. A replay replaces them once
/// nothing else can fail. At that time its recorder owns the [`RecordingFolder`], so the replay
/// keeps this second handle.
pub struct EarlierClips {
    dir: Arc<ClipDir>,
}

/// A folder of clips with their list, locked by one process at a time.
pub struct RecordingFolder {
    pub(super) dir: Arc<ClipDir>,
    retention: Option<Retention>,
    losses: Arc<LossList>,
    unfinished: Recovery,
}

impl RecordingFolder {
    /// Opens and locks the folder `out`, which is created if it does not exist. Then completes and
    /// lists the unfinished clips of an earlier process, and returns them. A clip that cannot be
    /// completed, for example because the disk is full, is logged and left unchanged for a later
    /// process.
    ///
    /// # Errors
    ///
    /// [`RecordError::Busy`] if another process records into it; other [`RecordError`]s if the
    /// folder cannot be created, locked or read.
    pub fn open(out: &Path) -> Result<(Self, Vec<Clip>), RecordError> {
        let mut folder = Self::open_without_recovery(out)?;
        let mut recovery = folder.take_unfinished();
        let mut found = Vec::new();
        while let Some(recovered) = recovery.next(&mut || true) {
            match recovered {
                Ok(clip) => found.push(clip),
                Err(error) => {
                    warn!(
                        error = &error as &dyn std::error::Error,
                        "cannot recover a clip; left for a later start"
                    )
                }
            }
        }
        Ok((folder, found))
    }

    /// Opens the folder as [`RecordingFolder::open`] does, but does not complete unfinished clips:
    /// the writer thread of [`crate::Recorder::live`] completes them while it records.
    ///
    /// # Errors
    ///
    /// As for [`RecordingFolder::open`].
    pub fn open_without_recovery(out: &Path) -> Result<Self, RecordError> {
        let clips = out.join(CLIPS);
        safe_file::folder(&clips)
            .map_err(|source| RecordError::Create { path: clips.clone(), source })?;
        let lock = lock(&clips, out)?;
        let list = ClipList::of(out);
        replaced::complete(&clips, &list)?;
        let taken: HashSet<String> = list.read()?.into_iter().map(|listed| listed.file).collect();
        let dir = Arc::new(ClipDir::new(clips, list, taken, lock));
        let unfinished = Recovery::of(&dir)?;
        Ok(Self { dir, retention: None, losses: Arc::new(LossList::of(out)), unfinished })
    }

    /// Takes the unfinished clips of an earlier process out of this handle. The caller completes
    /// them.
    pub(crate) fn take_unfinished(&mut self) -> Recovery {
        std::mem::take(&mut self.unfinished)
    }

    /// Replaces the listed clips as [`EarlierClips::replace`] does, with its errors.
    pub fn replace(&mut self, keep: &[Clip]) -> Result<u64, RecordError> {
        self.earlier().replace(keep)
    }

    /// Returns a handle of the listed clips.
    pub fn earlier(&self) -> EarlierClips {
        EarlierClips { dir: Arc::clone(&self.dir) }
    }

    /// Limits the number of clips, or their bytes, from now on. Above the limit, the oldest clips
    /// that were not fetched are deleted, after each is noted in `losses.jsonl`. Existing clips
    /// count: returns those that were deleted now, and those that could not be deleted.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the list of clips cannot be read.
    pub fn keep_at_most(
        &mut self,
        clips: Option<u64>,
        bytes: Option<u64>,
    ) -> Result<Vec<Loss>, RecordError> {
        let retention =
            Retention::new(&self.dir, self.losses(), self.dir.list().read()?, clips, bytes);
        Ok(self.retention.insert(retention).make_room(&self.dir))
    }

    /// Signs the clips that are begun or recovered from now on. One that cannot be signed is
    /// written without a signature.
    pub fn sign_clips(&self, signer: ClipSigner) {
        self.dir.sign_with(signer);
    }

    /// Returns the running number of clips that could not be signed.
    pub(crate) fn unsigned(&self) -> Arc<AtomicU64> {
        self.dir.unsigned()
    }

    pub fn losses(&self) -> Arc<LossList> {
        Arc::clone(&self.losses)
    }

    /// Makes room for a finished clip, if there is a limit. Returns the deleted clips, and those
    /// that could not be deleted.
    pub(crate) fn make_room(&mut self, clip: &Clip) -> Vec<Loss> {
        self.retention.as_mut().map_or(Vec::new(), |retention| retention.add(&self.dir, clip))
    }

    /// Begins a clip named `base`, or `base-2`, `base-3` and so on if the name is taken;
    /// [`RecordError`] if its file cannot be created or written.
    pub(crate) fn begin(
        &mut self,
        base: &str,
        clip_header: &ClipHeader,
    ) -> Result<UnfinishedClip, RecordError> {
        let name = self.dir.free_name(base);
        UnfinishedClip::create(Arc::clone(&self.dir), name, PART, Some(clip_header))
    }
}

impl EarlierClips {
    /// Reduces the list to the clips in `keep`. Deletes the other listed clips with their
    /// thumbnails, and returns their number. Lines that name no clip of this program stay.
    ///
    /// Only plain files in the folder of clips are deleted, whatever the list names.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the list cannot be written; then nothing is deleted.
    pub fn replace(&self, keep: &[Clip]) -> Result<u64, RecordError> {
        let dir = &self.dir;
        let kept: HashSet<PathBuf> = keep.iter().map(|clip| clip.file.clone()).collect();
        let is_kept =
            |listed: &ListedClip| kept.contains(Path::new(CLIPS).join(&listed.file).as_path());
        let (listed, removed): (Vec<_>, Vec<_>) = dir.list().read()?.into_iter().partition(is_kept);
        // Clips leave the list before they are deleted, so that it never names a deleted clip. They
        // are noted before that: otherwise, after a death of this process, the next start would
        // find complete clips that are not listed, and list them as results of another replay.
        replaced::note(dir.folder(), &removed)?;
        dir.list().replace(keep)?;
        let deleted = replaced::complete(dir.folder(), dir.list())?;
        dir.take_only(listed.into_iter().map(|listed| listed.file).collect());
        Ok(deleted)
    }
}

fn lock(clips: &Path, out: &Path) -> Result<File, RecordError> {
    let path = clips.join(".lock");
    let file = safe_file::write(&path)
        .map_err(|source| RecordError::Create { path: path.clone(), source })?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(RecordError::Busy { folder: out.to_owned() }),
        Err(TryLockError::Error(source)) => Err(RecordError::Lock { path, source }),
    }
}
