//! Files of chunks, each under its SHA-256.

use std::io;
use std::sync::atomic::{AtomicU64, Ordering};

use futures_util::StreamExt;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::UnfinishedFile;
use tokio::time::timeout;

use super::{RecordArchive, chunk};
use crate::error::{CloudError, CloudResult};
use crate::folder::PART;
use crate::place::{FilePlace, blocking};
use crate::store::{KeptLine, StoredChunk};
use crate::transfer::PIECE_TIME;

#[derive(Debug)]
pub(crate) struct ChunkFiles {
    place: FilePlace,
    parts: AtomicU64,
}

impl ChunkFiles {
    pub(crate) fn new(place: FilePlace) -> Self {
        Self { place, parts: AtomicU64::new(0) }
    }

    /// Stores a file, durable.
    pub(super) async fn keep(&self, sha256: &str, file: Vec<u8>) -> io::Result<()> {
        let number = self.parts.fetch_add(1, Ordering::Relaxed);
        let part = self.place.folder().join(format!("{sha256}.{number}.{PART}"));
        let path = part.clone();
        let part = UnfinishedFile(part);
        blocking(move || std::fs::write(path, file)).await?;
        self.place.keep(&part, sha256).await
    }

    /// Returns a file, if it is there: at most one byte more than `length`.
    async fn content(&self, sha256: &str, length: u64) -> io::Result<Option<Vec<u8>>> {
        let Some(body) = self.place.content(sha256, 0).await? else { return Ok(None) };
        let most = usize::try_from(length).unwrap_or(usize::MAX).saturating_add(1);
        let (mut content, mut pieces) = (Vec::new(), body.into_data_stream());
        while content.len() < most {
            let Some(piece) = timeout(PIECE_TIME, pieces.next()).await? else { break };
            let piece = piece.map_err(io::Error::other)?;
            content.extend_from_slice(&piece[..piece.len().min(most - content.len())]);
        }
        Ok(Some(content))
    }

    pub(super) async fn remove(&self, sha256: &str) -> io::Result<()> {
        self.place.remove(sha256).await
    }
}

/// The content of a chunk, as far as it can be read.
pub(super) enum ChunkContent {
    Lines(Vec<KeptLine>),
    /// The line in the place of one whose file cannot be used, with the reason.
    Damaged(KeptLine),
}

impl RecordArchive {
    /// Reads a chunk. `None` if it was removed meanwhile.
    ///
    /// # Errors
    ///
    /// An error if the place of the files cannot be reached: then nothing is known of the file.
    pub(super) async fn chunk_content(
        &self,
        of: (&str, &str),
        stored: &StoredChunk,
    ) -> CloudResult<Option<ChunkContent>> {
        let StoredChunk { sha256, stored_bytes, .. } = stored;
        let file = self.chunks.content(sha256, *stored_bytes).await.map_err(unreachable)?;
        let lines = match file {
            None => Err("it is missing".to_owned()),
            Some(file) => {
                let (names, entry) = ((of.0.to_owned(), of.1.to_owned()), stored.clone());
                let decode = move || Ok(chunk::decode((&names.0, &names.1), &entry, &file));
                blocking(decode).await.map_err(unreachable)?
            }
        };
        match lines {
            Ok(lines) => Ok(Some(ChunkContent::Lines(lines))),
            Err(_) if !self.store.has_chunk(of, stored).await? => Ok(None),
            Err(reason) => {
                tracing::error!(
                    vehicle = of.0,
                    stream = of.1,
                    sha256,
                    reason,
                    "a chunk of records cannot be used"
                );
                Ok(Some(ChunkContent::Damaged(chunk::damaged(of.1, stored, &reason))))
            }
        }
    }
}

fn unreachable(error: io::Error) -> CloudError {
    Failure::caused_by(Exit::Unreachable, "files of records cannot be read now", &error)
        .with_help("check the place of the files, and try again")
        .into()
}
