//! Clips: announced by vehicles, wanted by people, and sent in parts.
//!
//! `receiving` has announcements and parts, `fetching` sends files to people, and `files` has
//! these. A vehicle reads the complete list of what is wanted: there is no command that could be
//! lost or come twice. Nothing here deletes anything on a vehicle.

mod fetching;
mod files;
mod receiving;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::time::Duration;

use gleaner_fleet::clips::ClipId;
use tokio::time::interval;

pub(crate) use files::ClipFiles;
use files::FileOfClip;
pub(crate) use receiving::is_thumbnail;

use crate::error::CloudResult;
use crate::hub::Hub;
use crate::store::{CloudStore, RemovedClip};

/// Interval of looks for unfinished files that are not continued.
const CLEANING: Duration = Duration::from_secs(600);

#[derive(Clone)]
pub(crate) struct FleetClips {
    store: Arc<CloudStore>,
    hub: Arc<Hub>,
    files: Arc<ClipFiles>,
}

impl FleetClips {
    pub(crate) fn new(store: &Arc<CloudStore>, hub: &Arc<Hub>, files: ClipFiles) -> Self {
        Self { store: Arc::clone(store), hub: Arc::clone(hub), files: Arc::new(files) }
    }

    /// Removes clips that the rules do not keep, and the files of all that were removed.
    async fn remove_expired(&self) -> CloudResult<()> {
        while self.store.expire_clips().await? {}
        self.remove_files().await
    }

    /// Removes the files of clips that were removed. Those that cannot be removed stay noted for
    /// the next time.
    async fn remove_files(&self) -> CloudResult<()> {
        loop {
            let removed = self.store.removed_clips().await?;
            let mut has_progress = false;
            for id in removed {
                has_progress |= self.remove_files_of(id).await?;
            }
            if !has_progress {
                return Ok(());
            }
        }
    }

    /// Removes the files of a clip that do not count any more; returns whether none is left.
    async fn remove_files_of(&self, id: ClipId) -> CloudResult<bool> {
        // A part that is being stored ends first, and no other one begins meanwhile.
        let _turn = self.files.turn(&id).await;
        self.remove_noted(id).await
    }

    /// As [`Self::remove_files_of`], for the one who has the turn of the clip.
    async fn remove_noted(&self, id: ClipId) -> CloudResult<bool> {
        // Its vehicle may have announced and sent it again.
        let RemovedClip { id, has_file, has_thumbnail } = self.store.removed_clip(id).await?;
        let mut removed = Ok(());
        if !has_file {
            removed = self.files.remove_recording(&id).await;
        }
        if !has_thumbnail {
            removed = removed.and(self.files.remove_thumbnail(&id).await);
        }
        if let Err(error) = removed {
            tracing::warn!(
                clip = %id, %error, "could not delete a file; will retry"
            );
            return Ok(false);
        }
        self.store.forget_removed_clip(&id).await?;
        Ok(true)
    }

    /// Removes old clips, and unfinished files that are not continued, for as long as the program
    /// runs.
    pub(crate) async fn clean(&self) {
        let mut looks = interval(CLEANING);
        loop {
            looks.tick().await;
            let forgotten =
                self.store.forget_unfinished_clips(self.files.bounds.unfinished_s).await;
            if let Err(error) = forgotten {
                let reason = error.reason();
                tracing::warn!(reason, "could not delete unfinished clips; will retry");
            }
            if let Err(error) = self.remove_expired().await {
                tracing::warn!(reason = error.reason(), "could not delete old clips; will retry");
            }
        }
    }
}
