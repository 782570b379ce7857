//! Files of revisions, by their SHA-256. A file appears under its digest only when it is complete
//! and durable, and is never changed afterwards.

use std::collections::BTreeMap;
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::body::Body;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::{AnnouncedFile, UnfinishedFile};
use gleaner_lambda::manifest::Sha256;
use gleaner_protocol::vehicle_api::MissingObject;
use gleaner_trust::Revision;
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use crate::error::{CloudError, CloudResult};
use crate::folder::PART;
use crate::place::FilePlace;
use crate::store::CloudStore;

/// Length of the pieces in which a file is sent.
const PIECE: usize = 64 << 10;

/// All files.
#[derive(Debug)]
pub(crate) struct Objects {
    place: FilePlace,
    parts: AtomicU64,
}

impl Objects {
    /// Creates the access to a place of files.
    pub(crate) fn new(place: FilePlace) -> Self {
        Self { place, parts: AtomicU64::new(0) }
    }

    /// Returns the files of `revisions` that are not stored.
    pub(crate) async fn missing<'r>(
        &self,
        revisions: impl IntoIterator<Item = &'r Revision>,
    ) -> CloudResult<Vec<MissingObject>> {
        let files = revisions.into_iter().flat_map(|revision| &revision.files);
        let files: BTreeMap<_, _> =
            files.map(|file| (file.sha256.to_string(), file.bytes)).collect();
        let mut missing = Vec::new();
        for (sha256, bytes) in files {
            let stored = self.place.length(&sha256).await.map_err(|error| {
                let action = format!("cannot look for the file {sha256}");
                Failure::caused_by(Exit::Internal, action, &error)
            })?;
            if stored != Some(bytes) {
                missing.push(MissingObject { sha256, bytes });
            }
        }
        Ok(missing)
    }

    /// Receives a file. It counts only if its length and digest are right.
    pub(crate) async fn receive(
        &self,
        store: &CloudStore,
        sha256: &Sha256,
        body: Body,
    ) -> CloudResult<()> {
        let length = store.awaited_length(sha256.as_str()).await?;
        let number = self.parts.fetch_add(1, Ordering::Relaxed);
        let part = self.place.folder().join(format!("{sha256}.{number}.{PART}"));
        let part = UnfinishedFile(part);
        let failed = |error: io::Error| {
            Failure::caused_by(Exit::Internal, format!("cannot receive the file {sha256}"), &error)
        };
        let refused = |reason: String| {
            let help = "send the file again, as it was published";
            CloudError::denied(format!("the file {sha256} is refused"), help).because(reason)
        };
        let mut file = File::create_new(&part.0).await.map_err(failed)?;
        let mut announced = AnnouncedFile::new(length, sha256.as_str());
        let mut body = body.into_data_stream();
        while let Some(piece) = body.next().await {
            let piece = piece.map_err(|error| failed(io::Error::other(error)))?;
            announced.add(&piece).map_err(refused)?;
            file.write_all(&piece).await.map_err(failed)?;
        }
        announced.finish().map_err(refused)?;
        file.flush().await.map_err(failed)?;
        Ok(self.place.keep(&part, sha256.as_str()).await.map_err(failed)?)
    }

    /// Returns the answer with a file.
    pub(crate) async fn send(&self, sha256: &Sha256) -> CloudResult<Response> {
        let missing = || {
            let help = "deploy the revision again, which sends missing files";
            CloudError::missing(format!("the file {sha256} is missing"), help)
        };
        let failed = |error| {
            Failure::caused_by(Exit::Internal, format!("cannot send the file {sha256}"), &error)
        };
        let length = self.place.length(sha256.as_str()).await.map_err(failed)?;
        let length = length.ok_or_else(missing)?;
        let content = self.place.content(sha256.as_str(), 0).await.map_err(failed)?;
        let content = content.ok_or_else(missing)?;
        let headers = [(header::CONTENT_LENGTH, length.to_string()), octets()];
        Ok((headers, content).into_response())
    }
}

/// Returns the rest of a file as the body of an answer, which is read piece by piece.
pub(crate) fn body_of(file: File) -> Body {
    Body::from_stream(futures_util::stream::try_unfold(file, async |mut file| {
        let mut piece = Vec::with_capacity(PIECE);
        (&mut file).take(PIECE as u64).read_to_end(&mut piece).await?;
        io::Result::Ok((!piece.is_empty()).then_some((piece, file)))
    }))
}

/// Returns the type of a file whose content does not matter.
pub(crate) fn octets() -> (header::HeaderName, String) {
    (header::CONTENT_TYPE, "application/octet-stream".to_owned())
}
