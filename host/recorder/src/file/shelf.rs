//! How much room clips may take. Beyond it the oldest go, and what goes is named.

use std::collections::VecDeque;
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_protocol::Clip;
use gleaner_protocol::link::Loss;
use tracing::warn;

use super::durable;
use super::list::Listed;
use super::place::{CLIPS, Place};
use crate::error::RecordError;

/// The clips that are there, oldest first, and how many there may be.
pub(super) struct Shelf {
    clips_max: u64,
    bytes_max: u64,
    clips: VecDeque<Kept>,
    bytes: u64,
}

struct Kept {
    file: String,
    thumbnail: Option<String>,
    bytes: u64,
}

impl Shelf {
    /// Over the clips that are listed. One that is not there was fetched.
    pub(super) fn new(place: &Place, listed: Vec<Listed>, clips_max: Option<u64>, bytes_max: Option<u64>) -> Shelf {
        let (clips_max, bytes_max) = (clips_max.unwrap_or(u64::MAX), bytes_max.unwrap_or(u64::MAX));
        let mut shelf = Shelf { clips_max, bytes_max, clips: VecDeque::new(), bytes: 0 };
        for Listed { file, thumbnail } in listed {
            let bytes = place.folder().join(&file).symlink_metadata().ok().filter(|metadata| metadata.is_file());
            if let Some(bytes) = bytes.map(|metadata| metadata.len()) {
                shelf.push(Kept { file, thumbnail, bytes });
            }
        }
        shelf
    }

    fn push(&mut self, kept: Kept) {
        self.bytes += kept.bytes;
        self.clips.push_back(kept);
    }

    /// Adds a clip that is whole now; deletes the oldest until the others have room. The newest stays in any case.
    pub(super) fn add(&mut self, place: &Place, clip: &Clip) -> Result<Vec<Loss>, RecordError> {
        let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
        let (file, thumbnail) = (name(&clip.file), clip.thumbnail.as_deref().and_then(name));
        if let Some(file) = file {
            self.push(Kept { file, thumbnail, bytes: clip.bytes });
        }
        self.make_room(place)
    }

    /// Deletes the oldest until the others have room.
    pub(super) fn make_room(&mut self, place: &Place) -> Result<Vec<Loss>, RecordError> {
        // Those that somebody has fetched take no room any more.
        self.clips.retain(|kept| place.folder().join(&kept.file).symlink_metadata().is_ok());
        self.bytes = self.clips.iter().map(|kept| kept.bytes).sum();
        let mut losses = Vec::new();
        while self.clips.len() > 1 && (self.clips.len() as u64 > self.clips_max || self.bytes > self.bytes_max) {
            let Some(gone) = self.clips.front() else { break };
            let path = place.folder().join(&gone.file);
            let why = match self.clips.len() as u64 > self.clips_max {
                true => format!("there may be {} clips", self.clips_max),
                false => format!("clips may take {} MiB", self.bytes_max >> 20),
            };
            warn!(clip = %gone.file, %why, "oldest clip deleted, nobody had fetched it");
            let loss =
                Loss::Deleted { at_ns: now(), file: PathBuf::from(CLIPS).join(&gone.file), bytes: gone.bytes, why };
            // What is lost is told before it is.
            note(place, &loss)?;
            if let Some(thumbnail) = &gone.thumbnail {
                durable::remove(&place.folder().join(thumbnail))?;
            }
            durable::remove(&path)?;
            self.bytes -= gone.bytes;
            self.clips.pop_front();
            losses.push(loss);
        }
        Ok(losses)
    }
}

/// Adds a line to `losses.jsonl`.
fn note(place: &Place, loss: &Loss) -> Result<(), RecordError> {
    let path = place.list().folder().join("losses.jsonl");
    let failed = |source| RecordError::List { path: path.clone(), source };
    let mut line = serde_json::to_vec(loss).expect("a loss is plain data");
    line.push(b'\n');
    let mut file = OpenOptions::new().append(true).create(true).open(&path).map_err(failed)?;
    file.write_all(&line).and_then(|()| file.sync_data()).map_err(failed)
}

fn now() -> i64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(now.as_nanos()).unwrap_or(i64::MAX)
}
