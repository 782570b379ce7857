//! Files of clips, under names that are digests of their ids.
//!
//! Parts have any length: as much of a request as has come. In a folder, they are appended to the
//! file one after the other; in a bucket, each is an object with its digest in the name: a part
//! that comes to another replica replaces none. Which parts count is in the database only.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use axum::body::Body;
use futures_util::stream::try_unfold;
use futures_util::{StreamExt, TryStreamExt};
use gleaner_base::sync_folder;
use gleaner_fleet::clips::ClipId;
use gleaner_fleet::{AnnouncedFile, UnfinishedFile};
use gleaner_trust::sha256;
use tokio::sync::{Mutex, OwnedMutexGuard};
use tokio::time::timeout;

use crate::error::CloudResult;
use crate::folder::PART;
use crate::place::{FilePlace, blocking};
use crate::store::{ClipBounds, ClipProgress, StoredPart};
use crate::transfer::{IncomingFile, PIECE_TIME, ReceivedPiece, StoredBytes};

/// Time without any byte after which a piece ends: sooner than a vehicle notices that a connection
/// is dead, and asks where to go on.
const SILENCE: Duration = Duration::from_secs(15);
/// Number of locks for all files.
const TURNS: usize = 64;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum FileOfClip {
    /// The recording, of this length, with its parts.
    Recording(u64, Vec<StoredPart>),
    Thumbnail,
}

#[derive(Debug)]
pub(crate) struct ClipFiles {
    place: FilePlace,
    pub(crate) bounds: ClipBounds,
    parts: AtomicU64,
    turns: Vec<Arc<Mutex<()>>>,
}

impl ClipFiles {
    pub(crate) fn new(place: FilePlace, bounds: ClipBounds) -> Self {
        let turns = (0..TURNS).map(|_| Arc::default()).collect();
        Self { place, bounds, parts: AtomicU64::new(0), turns }
    }

    /// Returns the path of the recording of a clip in the folder.
    fn path(&self, id: &ClipId) -> PathBuf {
        self.place.folder().join(recording(id))
    }

    /// Returns whether any of the recording of a clip is there.
    pub(crate) async fn has_recording(
        &self,
        id: &ClipId,
        parts: &[StoredPart],
    ) -> io::Result<bool> {
        let name = match (self.place.is_bucket(), parts.first()) {
            (false, _) => recording(id),
            (true, Some(first)) => part_name(id, 0, &first.sha256),
            (true, None) => return Ok(false),
        };
        Ok(self.place.length(&name).await?.is_some())
    }

    /// Returns the length of a file that is complete, if it is there.
    pub(crate) async fn length(&self, id: &ClipId, file: &FileOfClip) -> io::Result<Option<u64>> {
        match file {
            FileOfClip::Thumbnail => self.place.length(&thumbnail(id)).await,
            FileOfClip::Recording(length, parts) if self.place.is_bucket() => {
                Ok(self.has_recording(id, parts).await?.then_some(*length))
            }
            FileOfClip::Recording(..) => self.place.length(&recording(id)).await,
        }
    }

    /// Returns the content of a file that is complete from the byte `begin` on, if it is there.
    pub(crate) async fn content(
        self: &Arc<Self>,
        id: &ClipId,
        file: FileOfClip,
        begin: u64,
    ) -> io::Result<Option<Body>> {
        match file {
            FileOfClip::Thumbnail => self.place.content(&thumbnail(id), begin).await,
            FileOfClip::Recording(length, parts) if self.place.is_bucket() => {
                Ok(Some(self.parts_from(id, (length, parts), begin)))
            }
            FileOfClip::Recording(..) => self.place.content(&recording(id), begin).await,
        }
    }

    /// Returns the parts of a recording in a bucket, one after the other.
    fn parts_from(
        self: &Arc<Self>,
        id: &ClipId,
        (length, parts): (u64, Vec<StoredPart>),
        begin: u64,
    ) -> Body {
        let mut end = 0;
        let parts = parts.into_iter().zip(0..).map(move |(part, number)| {
            end += part.bytes;
            (number, end - part.bytes, part)
        });
        let (files, id) = (Arc::clone(self), id.clone());
        let parts = parts.filter(move |(_, at, part)| at + part.bytes > begin);
        let start = (files, id, parts, begin);
        let parts = try_unfold(start, move |(files, id, mut parts, begin)| async move {
            if begin >= length {
                return io::Result::Ok(None);
            }
            let lost = || io::Error::from(io::ErrorKind::NotFound);
            let (number, at, StoredPart { sha256, bytes }) = parts.next().ok_or_else(lost)?;
            let (skipped, end) = (begin - at, at + bytes);
            let part = files.place.content(&part_name(&id, number, &sha256), skipped).await?;
            let part = part.ok_or_else(lost)?;
            // A longer or shorter one would move all that follows.
            let stored = StoredBytes::new(&format!("part {number} of clip `{id}`"), end - begin);
            let stored = if skipped == 0 { stored.with_sha256(&sha256) } else { stored };
            let pieces = stored.checked(part).into_data_stream();
            let pieces = pieces.map(|it| it.map_err(io::Error::other));
            Ok(Some((pieces, (files, id, parts, end))))
        });
        Body::from_stream(parts.try_flatten())
    }

    pub(crate) async fn remove_recording(&self, id: &ClipId) -> io::Result<()> {
        self.place.remove(&recording(id)).await
    }

    pub(crate) async fn remove_thumbnail(&self, id: &ClipId) -> io::Result<()> {
        self.place.remove(&thumbnail(id)).await
    }

    /// Waits until no other part of a clip is stored.
    pub(crate) async fn turn(&self, id: &ClipId) -> OwnedMutexGuard<()> {
        let digest = sha256(id.to_string().as_bytes());
        let index = usize::from_str_radix(&digest.as_str()[..4], 16).unwrap_or(0) % TURNS;
        Arc::clone(&self.turns[index]).lock_owned().await
    }

    /// Receives at most so many bytes into a file of their own, as many as come.
    pub(crate) async fn receive(
        &self,
        id: &ClipId,
        length: u64,
        body: Body,
    ) -> CloudResult<ReceivedPiece> {
        let number = self.parts.fetch_add(1, Ordering::Relaxed);
        let path = self.path(id).with_extension(format!("{number}.{PART}"));
        let name = format!("a part of clip `{id}`");
        let file = IncomingFile { name: &name, length };
        let (file, received, _) = file.receive_some(SILENCE, path, body).await?;
        Ok(ReceivedPiece { file, bytes: received.received(), sha256: received.into_sha256() })
    }

    /// Makes a received file durable as the thumbnail of a clip.
    pub(crate) async fn keep_thumbnail(
        &self,
        id: &ClipId,
        part: &UnfinishedFile,
    ) -> io::Result<()> {
        self.place.keep(part, &thumbnail(id)).await
    }

    /// Makes a received part durable as the next one of the recording of a clip. Returns false if
    /// the parts before it are not there. Until the database has it, it may come again.
    pub(crate) async fn append(
        &self,
        progress: &ClipProgress,
        piece: ReceivedPiece,
    ) -> io::Result<bool> {
        let ClipProgress { id, part, received, .. } = progress;
        if self.place.is_bucket() {
            let name = part_name(id, *part, &piece.sha256);
            return self.place.keep(&piece.file, &name).await.map(|()| true);
        }
        let (path, begin) = (self.path(id), *received);
        blocking(move || append(&path, begin, &piece.file)).await
    }

    /// Compares a recording with its announced length and SHA-256; returns the reason if it is
    /// another one.
    pub(crate) async fn compare(
        self: &Arc<Self>,
        id: &ClipId,
        (length, sha256): (u64, String),
        parts: Vec<StoredPart>,
    ) -> io::Result<Result<(), String>> {
        if !self.place.is_bucket() {
            let path = self.path(id);
            return blocking(move || {
                AnnouncedFile::new(length).compare(&sha256, File::open(path)?)
            })
            .await;
        }
        let mut announced = AnnouncedFile::new(length);
        let mut pieces = self.parts_from(id, (length, parts), 0).into_data_stream();
        while let Some(piece) = timeout(PIECE_TIME, pieces.next()).await? {
            if let Err(reason) = announced.add(&piece.map_err(io::Error::other)?) {
                return Ok(Err(reason));
            }
        }
        Ok(announced.finish(&sha256))
    }
}

fn append(path: &Path, begin: u64, part: &UnfinishedFile) -> io::Result<bool> {
    let mut file = File::options().write(true).create(true).truncate(false).open(path)?;
    if file.metadata()?.len() < begin {
        return Ok(false);
    }
    file.set_len(begin)?;
    file.seek(SeekFrom::Start(begin))?;
    io::copy(&mut File::open(&part.0)?, &mut file)?;
    file.flush()?;
    file.sync_all()?;
    if begin == 0 {
        path.parent().map_or(Ok(()), sync_folder)?;
    }
    Ok(true)
}

fn recording(id: &ClipId) -> String {
    format!("{}.mcap", sha256(id.to_string().as_bytes()))
}

fn part_name(id: &ClipId, number: u64, sha256: &str) -> String {
    format!("{}/{number}-{sha256}", recording(id))
}

fn thumbnail(id: &ClipId) -> String {
    format!("{}.jpg", sha256(id.to_string().as_bytes()))
}
