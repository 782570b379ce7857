//! The folder of clips: files under names that are digests of their ids.
//!
//! The parts of a file are appended to it one after the other, each once it is complete and its
//! digest is right. How many there are is in the database only: bytes after them do not count.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{self, Arc, PoisonError};

use axum::body::Body;
use gleaner_base::{Failure, sync_folder};
use gleaner_fleet::UnfinishedFile;
use gleaner_fleet::clips::{CLIP_PART, ClipId};
use gleaner_trust::sha256;
use tokio::sync::{Mutex, OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};

use crate::error::{CloudError, CloudResult};
use crate::folder::{PART, remove_parts};
use crate::store::ClipBounds;
use crate::transfer::IncomingFile;

/// Number of parts of a vehicle that are received at a time: some may be of connections that it
/// has lost.
const PARTS_MAX: usize = 4;
/// Number of locks for all files.
const TURNS: usize = 64;

/// The folder.
#[derive(Debug)]
pub(crate) struct ClipFiles {
    folder: PathBuf,
    pub(crate) bounds: ClipBounds,
    parts: AtomicU64,
    /// Slots of the vehicles that send parts.
    slots: sync::Mutex<BTreeMap<String, Arc<Semaphore>>>,
    turns: Vec<Arc<Mutex<()>>>,
}

impl ClipFiles {
    /// Opens the folder, and removes parts that an earlier process left.
    ///
    /// # Errors
    ///
    /// A failure that names the folder.
    pub(crate) fn open(folder: PathBuf, bounds: ClipBounds) -> Result<Self, Failure> {
        remove_parts(&folder)?;
        let turns = (0..TURNS).map(|_| Arc::default()).collect();
        Ok(Self { folder, bounds, parts: AtomicU64::new(0), slots: sync::Mutex::default(), turns })
    }

    fn path(&self, id: &ClipId, extension: &str) -> PathBuf {
        self.folder.join(format!("{}.{extension}", sha256(id.to_string().as_bytes())))
    }

    /// Returns the path of the file of a clip.
    pub(crate) fn clip(&self, id: &ClipId) -> PathBuf {
        self.path(id, "mcap")
    }

    /// Returns the path of the thumbnail of a clip.
    pub(crate) fn thumbnail(&self, id: &ClipId) -> PathBuf {
        self.path(id, "jpg")
    }

    /// Removes the file of a clip.
    pub(crate) fn remove_file(&self, id: &ClipId) {
        remove(&self.clip(id));
    }

    /// Removes the thumbnail of a clip.
    pub(crate) fn remove_thumbnail(&self, id: &ClipId) {
        remove(&self.thumbnail(id));
    }

    /// Returns a slot to receive a part of a vehicle in.
    pub(crate) fn slot(&self, vehicle: &str) -> CloudResult<OwnedSemaphorePermit> {
        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        slots.retain(|_, slots| slots.available_permits() < PARTS_MAX);
        let slots = slots.entry(vehicle.to_owned());
        let slots = slots.or_insert_with(|| Arc::new(Semaphore::new(PARTS_MAX)));
        Arc::clone(slots).try_acquire_owned().map_err(|_| {
            let message = format!("{PARTS_MAX} parts of the vehicle are received already");
            CloudError::busy(message, "send one part at a time")
        })
    }

    /// Waits until no other part of a clip is stored.
    pub(crate) async fn turn(&self, id: &ClipId) -> OwnedMutexGuard<()> {
        let digest = sha256(id.to_string().as_bytes());
        let index = usize::from_str_radix(&digest.as_str()[..4], 16).unwrap_or(0) % TURNS;
        Arc::clone(&self.turns[index]).lock_owned().await
    }

    /// Receives bytes with this length and SHA-256 into a file of their own.
    pub(crate) async fn receive(
        &self,
        id: &ClipId,
        (length, sha256): (u64, &str),
        body: Body,
    ) -> CloudResult<UnfinishedFile> {
        let number = self.parts.fetch_add(1, Ordering::Relaxed);
        let path = self.path(id, &format!("{number}.{PART}"));
        let name = format!("a part of clip `{id}`");
        IncomingFile { name: &name, length, sha256 }.receive(path, body).await
    }

    /// Makes a received file durable as the thumbnail of a clip.
    pub(crate) fn keep_thumbnail(&self, id: &ClipId, part: &UnfinishedFile) -> io::Result<()> {
        File::open(&part.0)?.sync_all()?;
        fs::rename(&part.0, self.thumbnail(id))?;
        sync_folder(&self.folder)
    }

    /// Makes a received part durable at its place in the file of a clip. Returns false if the
    /// parts before it are not there.
    pub(crate) fn append(
        &self,
        id: &ClipId,
        number: u64,
        part: &UnfinishedFile,
    ) -> io::Result<bool> {
        let mut options = File::options();
        let mut file = options.write(true).create(true).truncate(false).open(self.clip(id))?;
        let begin = number * CLIP_PART;
        if file.metadata()?.len() < begin {
            return Ok(false);
        }
        file.set_len(begin)?;
        file.seek(SeekFrom::Start(begin))?;
        io::copy(&mut File::open(&part.0)?, &mut file)?;
        file.flush()?;
        file.sync_all()?;
        if number == 0 {
            sync_folder(&self.folder)?;
        }
        Ok(true)
    }
}

fn remove(path: &Path) {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            tracing::warn!(path = %path.display(), %error, "a file cannot be removed");
        }
        _ => {}
    }
}
