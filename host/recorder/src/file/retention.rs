//! How much room clips may take. Beyond it the oldest go, and what goes is named.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::{Failure, nanoseconds};
use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use tracing::{error, warn};

use super::clip_dir::{CLIPS, ClipDir};
use super::durable;
use super::list::ListedClip;
use super::losses::LossList;
use crate::error::RecordError;

/// The clips that are there, oldest first, and how many there may be.
pub(super) struct Retention {
    clips_max: u64,
    bytes_max: u64,
    clips: VecDeque<StoredClip>,
    bytes: u64,
    losses: Arc<LossList>,
}

struct StoredClip {
    file: String,
    thumbnail: Option<String>,
    bytes: u64,
    /// It could not be deleted, and that was told.
    is_stuck: bool,
}

impl Retention {
    /// Over the clips that are listed. One that is not there was fetched.
    pub(super) fn new(
        dir: &ClipDir,
        losses: Arc<LossList>,
        listed: Vec<ListedClip>,
        clips_max: Option<u64>,
        bytes_max: Option<u64>,
    ) -> Retention {
        let (clips_max, bytes_max) = (clips_max.unwrap_or(u64::MAX), bytes_max.unwrap_or(u64::MAX));
        let mut retention =
            Retention { clips_max, bytes_max, clips: VecDeque::new(), bytes: 0, losses };
        for ListedClip { file, thumbnail } in listed {
            let bytes = dir
                .folder()
                .join(&file)
                .symlink_metadata()
                .ok()
                .filter(|metadata| metadata.is_file());
            if let Some(bytes) = bytes.map(|metadata| metadata.len()) {
                retention.push(StoredClip { file, thumbnail, bytes, is_stuck: false });
            }
        }
        retention
    }

    fn push(&mut self, kept: StoredClip) {
        self.bytes += kept.bytes;
        self.clips.push_back(kept);
    }

    /// Adds a clip that is whole now; deletes the oldest until the others have room. The newest
    /// stays in any case.
    pub(super) fn add(&mut self, dir: &ClipDir, clip: &Clip) -> Vec<Loss> {
        let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
        let (file, thumbnail) = (name(&clip.file), clip.thumbnail.as_deref().and_then(name));
        if let Some(file) = file {
            self.push(StoredClip { file, thumbnail, bytes: clip.bytes, is_stuck: false });
        }
        self.make_room(dir)
    }

    /// Deletes the oldest until the others have room. What cannot be deleted is passed over, and
    /// tried again the next time.
    pub(super) fn make_room(&mut self, dir: &ClipDir) -> Vec<Loss> {
        // Those that somebody has fetched take no room any more.
        self.clips.retain(|kept| dir.folder().join(&kept.file).symlink_metadata().is_ok());
        self.bytes = self.clips.iter().map(|kept| kept.bytes).sum();
        let mut losses_now = Vec::new();
        let mut skipped = 0;
        while self.clips.len() > skipped + 1
            && (self.clips.len() as u64 > self.clips_max || self.bytes > self.bytes_max)
        {
            let reason = match self.clips.len() as u64 > self.clips_max {
                true => format!("there may be {} clips", self.clips_max),
                false => format!("clips may take {} MiB", self.bytes_max >> 20),
            };
            let kept = &mut self.clips[skipped];
            match kept.delete(dir, &self.losses, reason) {
                Ok(deleted) => {
                    losses_now.push(deleted);
                    self.bytes -= kept.bytes;
                    self.clips.remove(skipped);
                }
                Err(error) => {
                    skipped += 1;
                    losses_now.extend(kept.stuck(&self.losses, error));
                }
            }
        }
        losses_now
    }
}

impl StoredClip {
    fn path(&self) -> PathBuf {
        PathBuf::from(CLIPS).join(&self.file)
    }

    /// Deletes it, because of `reason`. What is lost is told before it is.
    fn delete(
        &self,
        dir: &ClipDir,
        losses: &LossList,
        reason: String,
    ) -> Result<Loss, RecordError> {
        warn!(clip = %self.file, %reason, "oldest clip is deleted, nobody has fetched it");
        let deleted = Loss::Deleted { at_ns: now(), file: self.path(), bytes: self.bytes, reason };
        losses.note(&deleted)?;
        if let Some(thumbnail) = &self.thumbnail {
            durable::remove(&dir.folder().join(thumbnail))?;
        }
        durable::remove(&dir.folder().join(&self.file))?;
        Ok(deleted)
    }

    /// It could not be deleted: that is told once.
    fn stuck(&mut self, losses: &LossList, error: RecordError) -> Option<Loss> {
        if std::mem::replace(&mut self.is_stuck, true) {
            return None;
        }
        let failure = Failure::from(error);
        error!(clip = %self.file, %failure, "a clip cannot be deleted to make room, and stays");
        let reason =
            std::iter::once(failure.message).chain(failure.causes).collect::<Vec<_>>().join(": ");
        let loss = Loss::NotDeleted { at_ns: now(), file: self.path(), bytes: self.bytes, reason };
        if let Err(error) = losses.note(&loss) {
            error!(error = &error as &dyn std::error::Error, "cannot note a loss");
        }
        Some(loss)
    }
}

fn now() -> i64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    nanoseconds(now)
}
