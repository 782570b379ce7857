//! The folder that a recorder writes into.

use std::collections::HashSet;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use gleaner_base::own_file;
use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use tracing::warn;

use super::list::{List, Listed};
use super::losses::LossList;
use super::place::{CLIPS, PART, Place};
use super::recover::Recovery;
use super::shelf::Shelf;
use super::unfinished::Unfinished;
use super::{About, replaced};
use crate::error::RecordError;

/// The clips that are listed in a [`Folder`], which stays held. Who starts anew replaces them once
/// nothing is in the way, and then a recorder has the folder already.
pub struct Earlier {
    place: Arc<Place>,
}

/// A folder of clips with their list, held by one process at a time.
pub struct Folder {
    pub(super) place: Arc<Place>,
    shelf: Option<Shelf>,
    losses: Arc<LossList>,
    left: Recovery,
}

impl Folder {
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

    /// As [`Folder::open`], but what an earlier process left is not completed yet: the thread of
    /// [`crate::Recorder::live`] does that while it records.
    ///
    /// # Errors
    ///
    /// As for [`Folder::open`].
    pub fn hold(out: &Path) -> Result<Self, RecordError> {
        let clips = out.join(CLIPS);
        own_file::folder(&clips)
            .map_err(|source| RecordError::Create { path: clips.clone(), source })?;
        let lock = lock(&clips, out)?;
        let list = List::of(out);
        replaced::complete(&clips, &list)?;
        let taken: HashSet<String> = list.read()?.into_iter().map(|listed| listed.file).collect();
        let place = Arc::new(Place::new(clips, list, taken, lock));
        let left = Recovery::of(&place)?;
        Ok(Self { place, shelf: None, losses: Arc::new(LossList::of(out)), left })
    }

    /// What an earlier process left, for whoever completes it.
    pub(crate) fn take_left(&mut self) -> Recovery {
        std::mem::take(&mut self.left)
    }

    /// As [`Earlier::replace`].
    ///
    /// # Errors
    ///
    /// As there.
    pub fn replace(&mut self, keep: &[Clip]) -> Result<u64, RecordError> {
        self.earlier().replace(keep)
    }

    /// The clips that are listed in it.
    pub fn earlier(&self) -> Earlier {
        Earlier { place: Arc::clone(&self.place) }
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
        let shelf = Shelf::new(&self.place, self.losses(), self.place.list().read()?, clips, bytes);
        Ok(self.shelf.insert(shelf).make_room(&self.place))
    }

    /// `losses.jsonl`.
    pub fn losses(&self) -> Arc<LossList> {
        Arc::clone(&self.losses)
    }

    /// A clip was finished: makes room, if there is a bound. What went for it, and what should have
    /// and could not.
    pub(crate) fn added(&mut self, clip: &Clip) -> Vec<Loss> {
        self.shelf.as_mut().map_or(Vec::new(), |shelf| shelf.add(&self.place, clip))
    }

    /// Begins a clip named `stem`, or `stem-2`, `stem-3` and so on if there is one.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if its file cannot be made or written.
    pub(crate) fn begin(&mut self, stem: &str, about: &About) -> Result<Unfinished, RecordError> {
        let name = self.place.free_name(stem);
        Unfinished::create(Arc::clone(&self.place), name, PART, Some(about))
    }
}

impl Earlier {
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
        let place = &self.place;
        let kept: HashSet<PathBuf> = keep.iter().map(|clip| clip.file.clone()).collect();
        let is_kept =
            |listed: &Listed| kept.contains(Path::new(CLIPS).join(&listed.file).as_path());
        let (listed, doomed): (Vec<_>, Vec<_>) =
            place.list().read()?.into_iter().partition(is_kept);
        // The list never names a clip that is gone, and what it does not name any more is noted
        // before: else the next start would find whole clips that no list names, and list them as
        // results of another replay.
        replaced::note(place.folder(), &doomed)?;
        place.list().replace(keep)?;
        let deleted = replaced::complete(place.folder(), place.list())?;
        place.take_only(listed.into_iter().map(|listed| listed.file).collect());
        Ok(deleted)
    }
}

fn lock(clips: &Path, out: &Path) -> Result<File, RecordError> {
    let path = clips.join(".lock");
    let file = own_file::write(&path)
        .map_err(|source| RecordError::Create { path: path.clone(), source })?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(RecordError::Busy { folder: out.to_owned() }),
        Err(TryLockError::Error(source)) => Err(RecordError::Lock { path, source }),
    }
}
