//! Clips: announced by vehicles, wanted by people, and sent in parts.
//!
//! `vehicles` receives announcements and parts, `people` lists clips and sends their files, and
//! `files` has these. A vehicle reads the complete list of what is wanted: there is no command that
//! could be lost or come twice. Nothing here deletes anything on a vehicle.

mod files;
pub(crate) mod people;
#[cfg(test)]
mod tests;
mod vehicles;

use std::sync::Arc;
use std::time::Duration;

use gleaner_fleet::clips::ClipId;
use tokio::time::interval;

pub(crate) use files::{ClipFiles, FileOfClip};
pub(crate) use vehicles::{endpoints, is_thumbnail};

use crate::cloud::Cloud;
use crate::error::CloudResult;
use crate::store::RemovedClip;

/// Interval of looks for unfinished files that are not continued.
const CLEANING: Duration = Duration::from_secs(600);

/// Removes clips that the rules do not keep, and the files of all that were removed.
async fn remove_expired(cloud: &Cloud) -> CloudResult<()> {
    while cloud.store.expire_clips().await? {}
    remove_files(cloud).await
}

/// Removes the files of clips that were removed. Those that cannot be removed stay noted for the
/// next time.
async fn remove_files(cloud: &Cloud) -> CloudResult<()> {
    loop {
        let removed = cloud.store.removed_clips().await?;
        let mut has_progress = false;
        for id in removed {
            has_progress |= remove_files_of(cloud, id).await?;
        }
        if !has_progress {
            return Ok(());
        }
    }
}

/// Removes the files of a clip that do not count any more; returns whether none is left.
pub(crate) async fn remove_files_of(cloud: &Cloud, id: ClipId) -> CloudResult<bool> {
    // A part that is being stored ends first, and no other one begins meanwhile.
    let _turn = cloud.clips.turn(&id).await;
    remove_noted(cloud, id).await
}

/// As [`remove_files_of`], for the one who has the turn of the clip.
async fn remove_noted(cloud: &Cloud, id: ClipId) -> CloudResult<bool> {
    // Its vehicle may have announced and sent it again.
    let RemovedClip { id, has_file, has_thumbnail } = cloud.store.removed_clip(id).await?;
    let mut removed = Ok(());
    if !has_file {
        removed = cloud.clips.remove_recording(&id).await;
    }
    if !has_thumbnail {
        removed = removed.and(cloud.clips.remove_thumbnail(&id).await);
    }
    if let Err(error) = removed {
        tracing::warn!(clip = %id, %error, "a file cannot be removed, and is tried again later");
        return Ok(false);
    }
    cloud.store.forget_removed_clip(&id).await?;
    Ok(true)
}

/// Removes old clips, and unfinished files that are not continued, for as long as the program runs.
pub(crate) async fn clean(cloud: Arc<Cloud>) {
    let mut looks = interval(CLEANING);
    loop {
        looks.tick().await;
        let forgotten = cloud.store.forget_unfinished_clips(cloud.clips.bounds.unfinished_s).await;
        if let Err(error) = forgotten {
            tracing::warn!(reason = error.reason(), "unfinished clips are not removed");
        }
        if let Err(error) = remove_expired(&cloud).await {
            tracing::warn!(reason = error.reason(), "old clips are not removed");
        }
    }
}
