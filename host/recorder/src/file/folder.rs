//! The folder that a recorder writes into.

use std::collections::HashSet;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use gleaner_base::safe_file;
use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use tracing::warn;

use super::clip_dir::{CLIPS, ClipDir, PART};
use super::list::{ClipList, ListedClip};
use super::losses::LossList;
use super::recover::Recovery;
use super::retention::Retention;
use super::unfinished::UnfinishedClip;
use super::{ClipHeader, replaced};
use crate::error::RecordError;

/// The clips that are listed in a [`RecordingFolder`], which stays held. Who starts anew replaces them once
/// nothing is in the way, and then a recorder has the folder already.
pub struct EarlierClips {
    dir: Arc<ClipDir>,
}

/// A folder of clips with their list, held by one process at a time.
pub struct RecordingFolder {
    pub(super) dir: Arc<ClipDir>,
    retention: Option<Retention>,
    losses: Arc<LossList>,
    left: Recovery,
}

impl RecordingFolder {
    /// Opens the folder `out`, which is made if there is none, and takes it for this process.
    /// Whatever an earlier process left unfinished is completed first: the clips that came back by
    /// that are returned, and listed already. What cannot be completed, for example because the
    /// disk is full, is logged, and left as it is for a later process.
    ///
    /// # Errors
    ///
    /// [`RecordError::Busy`] if another process records into it; other [`RecordError`]s if the
    /// folder cannot be made, locked or read.
    pub fn open(out: &Path) -> Result<(Self, Vec<Clip>), RecordError> {
        let mut folder = Self::hold(out)?;
        let mut recovery = folder.take_left();
        let mut found = Vec::new();
        while let Some(came) = recovery.next(&mut || true) {
            match came {
                Ok(clip) => found.push(clip),
                Err(error) => {
                    warn!(
                        error = &error as &dyn std::error::Error,
                        "a clip cannot be recovered, left for a later start"
                    )
                }
            }
        }
        Ok((folder, found))
    }

    /// As [`RecordingFolder::open`], but what an earlier process left is not completed yet: the thread of
    /// [`crate::Recorder::live`] does that while it records.
    ///
    /// # Errors
    ///
    /// As for [`RecordingFolder::open`].
    pub fn hold(out: &Path) -> Result<Self, RecordError> {
        let clips = out.join(CLIPS);
        safe_file::folder(&clips)
            .map_err(|source| RecordError::Create { path: clips.clone(), source })?;
        let lock = lock(&clips, out)?;
        let list = ClipList::of(out);
        replaced::complete(&clips, &list)?;
        let taken: HashSet<String> = list.read()?.into_iter().map(|listed| listed.file).collect();
        let dir = Arc::new(ClipDir::new(clips, list, taken, lock));
        let left = Recovery::of(&dir)?;
        Ok(Self { dir, retention: None, losses: Arc::new(LossList::of(out)), left })
    }

    /// What an earlier process left, for whoever completes it.
    pub(crate) fn take_left(&mut self) -> Recovery {
        std::mem::take(&mut self.left)
    }

    /// As [`EarlierClips::replace`].
    ///
    /// # Errors
    ///
    /// As there.
    pub fn replace(&mut self, keep: &[Clip]) -> Result<u64, RecordError> {
        self.earlier().replace(keep)
    }

    /// The clips that are listed in it.
    pub fn earlier(&self) -> EarlierClips {
        EarlierClips { dir: Arc::clone(&self.dir) }
    }

    /// From now on there are at most so many clips, or so many bytes of them: of more, the oldest
    /// that nobody fetched are deleted, the present ones included. Each is named in `losses.jsonl`
    /// before; those that go at once are returned, and with them those that should and cannot be
    /// deleted.
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

    /// `losses.jsonl`.
    pub fn losses(&self) -> Arc<LossList> {
        Arc::clone(&self.losses)
    }

    /// A clip was finished: makes room, if there is a bound. What went for it, and what should have
    /// and could not.
    pub(crate) fn added(&mut self, clip: &Clip) -> Vec<Loss> {
        self.retention.as_mut().map_or(Vec::new(), |retention| retention.add(&self.dir, clip))
    }

    /// Begins a clip named `base`, or `base-2`, `base-3` and so on if there is one.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if its file cannot be made or written.
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
    /// Starts anew with the clips in `keep`: deletes the others that are listed, with their
    /// thumbnails, and says how many clips these were. Lines of the list that name no clip of ours
    /// stay.
    ///
    /// Only plain files in the folder of clips are deleted, whatever the list names.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the list cannot be written, and nothing is deleted then.
    pub fn replace(&self, keep: &[Clip]) -> Result<u64, RecordError> {
        let dir = &self.dir;
        let kept: HashSet<PathBuf> = keep.iter().map(|clip| clip.file.clone()).collect();
        let is_kept =
            |listed: &ListedClip| kept.contains(Path::new(CLIPS).join(&listed.file).as_path());
        let (listed, doomed): (Vec<_>, Vec<_>) = dir.list().read()?.into_iter().partition(is_kept);
        // The list never names a clip that is gone, and what it does not name any more is noted
        // before: else the next start would find whole clips that no list names, and list them as
        // results of another replay.
        replaced::note(dir.folder(), &doomed)?;
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
