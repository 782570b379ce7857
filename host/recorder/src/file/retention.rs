//! Retention: deletes the oldest clips over the limit, and notes each loss.

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

/// The existing clips, oldest first, and their limits.
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
    /// True if it could not be deleted, which was reported.
    is_stuck: bool,
}

impl Retention {
    /// Applies limits to the listed clips. A listed clip that does not exist was fetched.
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

    /// Adds a complete clip; deletes the oldest until the others are within the limits. The newest
    /// always stays.
    pub(super) fn add(&mut self, dir: &ClipDir, clip: &Clip) -> Vec<Loss> {
        let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
        let (file, thumbnail) = (name(&clip.file), clip.thumbnail.as_deref().and_then(name));
        if let Some(file) = file {
            self.push(StoredClip { file, thumbnail, bytes: clip.bytes, is_stuck: false });
        }
        self.make_room(dir)
    }

    /// Deletes the oldest until the others are within the limits. A clip that cannot be deleted is
    /// skipped, and retried the next time.
    pub(super) fn make_room(&mut self, dir: &ClipDir) -> Vec<Loss> {
        // Fetched clips do not count any more.
        self.clips.retain(|kept| dir.folder().join(&kept.file).symlink_metadata().is_ok());
        self.bytes = self.clips.iter().map(|kept| kept.bytes).sum();
        let mut reported = Vec::new();
        let mut skipped = 0;
        while self.clips.len() > skipped + 1
            && (self.clips.len() as u64 > self.clips_max || self.bytes > self.bytes_max)
        {
            let reason = match self.clips.len() as u64 > self.clips_max {
                true => format!("limit of {} clips", self.clips_max),
                false => format!("limit of {} MiB", self.bytes_max >> 20),
            };
            let kept = &mut self.clips[skipped];
            match kept.delete(dir, &self.losses, reason) {
                Ok(deleted) => {
                    reported.push(deleted);
                    self.bytes -= kept.bytes;
                    self.clips.remove(skipped);
                }
                Err(error) => {
                    skipped += 1;
                    reported.extend(kept.stuck(&self.losses, error));
                }
            }
        }
        reported
    }
}

impl StoredClip {
    fn path(&self) -> PathBuf {
        PathBuf::from(CLIPS).join(&self.file)
    }

    /// Deletes the clip, because of `reason`. The loss is noted before the deletion.
    fn delete(
        &self,
        dir: &ClipDir,
        losses: &LossList,
        reason: String,
    ) -> Result<Loss, RecordError> {
        warn!(clip = %self.file, %reason, "deleting the oldest clip, which was not fetched");
        let deleted = Loss::Deleted { at_ns: now(), file: self.path(), bytes: self.bytes, reason };
        losses.note(&deleted)?;
        if let Some(thumbnail) = &self.thumbnail {
            durable::remove(&dir.folder().join(thumbnail))?;
        }
        durable::remove(&dir.folder().join(&self.file))?;
        Ok(deleted)
    }

    /// Reports once that it could not be deleted.
    fn stuck(&mut self, losses: &LossList, error: RecordError) -> Option<Loss> {
        if std::mem::replace(&mut self.is_stuck, true) {
            return None;
        }
        let failure = Failure::from(error);
        error!(clip = %self.file, %failure, "cannot delete a clip to make room");
        let reason =
            std::iter::once(failure.message).chain(failure.causes).collect::<Vec<_>>().join(": ");
        let loss = Loss::NotDeleted { at_ns: now(), file: self.path(), bytes: self.bytes, reason };
        if let Err(error) = losses.note(&loss) {
            error!(error = &error as &dyn std::error::Error, "cannot write losses.jsonl");
        }
        Some(loss)
    }
}

fn now() -> i64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    nanoseconds(now)
}
