//! Files of revisions, by their SHA-256. A file appears under its digest only when it is complete
//! and durable, and is never changed afterwards.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use axum::body::Body;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use gleaner_base::{Exit, Failure, sync_folder};
use gleaner_fleet::{AnnouncedFile, UnfinishedFile};
use gleaner_lambda::manifest::Sha256;
use gleaner_protocol::vehicle_api::MissingObject;
use gleaner_trust::Revision;
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use crate::error::{CloudError, CloudResult};
use crate::folder::{PART, remove_parts};

/// Maximum number of deployments that wait for files.
const OFFERS_MAX: usize = 64;
/// Length of the pieces in which a file is sent.
const PIECE: usize = 64 << 10;

/// The folder of files.
#[derive(Debug)]
pub(crate) struct Objects {
    folder: PathBuf,
    /// Files that offered deployments need, by the id of the deployment.
    offers: Mutex<BTreeMap<String, Vec<MissingObject>>>,
    parts: AtomicU64,
}

impl Objects {
    /// Opens the folder, and removes what an earlier process left unfinished.
    ///
    /// # Errors
    ///
    /// A failure that names the folder.
    pub(crate) fn open(folder: PathBuf) -> Result<Self, Failure> {
        remove_parts(&folder)?;
        Ok(Self { folder, offers: Mutex::default(), parts: AtomicU64::new(0) })
    }

    /// Returns the files of `revisions` that are not stored.
    pub(crate) fn missing<'r>(
        &self,
        revisions: impl IntoIterator<Item = &'r Revision>,
    ) -> Vec<MissingObject> {
        let files = revisions.into_iter().flat_map(|revision| &revision.files);
        let missing = files.filter(|file| {
            let stored = fs::metadata(self.folder.join(file.sha256.as_str()));
            !stored.is_ok_and(|stored| stored.len() == file.bytes)
        });
        let missing: BTreeMap<_, _> =
            missing.map(|file| (file.sha256.to_string(), file.bytes)).collect();
        missing.into_iter().map(|(sha256, bytes)| MissingObject { sha256, bytes }).collect()
    }

    /// Accepts these files from now on, for the deployment `id`; without any, none for it.
    pub(crate) fn offer(&self, id: &str, objects: &[MissingObject]) -> CloudResult<()> {
        let mut offers = self.offers.lock().unwrap_or_else(PoisonError::into_inner);
        offers.remove(id);
        if objects.is_empty() {
            return Ok(());
        }
        if offers.len() >= OFFERS_MAX {
            let help = "send the files of those that were offered, or start the cloud again";
            return Err(CloudError::busy("too many deployments wait for files", help));
        }
        offers.insert(id.to_owned(), objects.to_vec());
        Ok(())
    }

    fn expected(&self, sha256: &Sha256) -> CloudResult<u64> {
        let offers = self.offers.lock().unwrap_or_else(PoisonError::into_inner);
        let mut files = offers.values().flatten();
        files.find(|file| file.sha256 == sha256.as_str()).map(|file| file.bytes).ok_or_else(|| {
            let help = "send the deployment first, and then the files that are missing";
            CloudError::usage(format!("no deployment needs the file {sha256}"), help)
        })
    }

    /// Receives a file. It counts only if its length and digest are right.
    pub(crate) async fn receive(&self, sha256: &Sha256, body: Body) -> CloudResult<()> {
        let length = self.expected(sha256)?;
        let number = self.parts.fetch_add(1, Ordering::Relaxed);
        let part = self.folder.join(format!("{sha256}.{number}.{PART}"));
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
        file.sync_all().await.map_err(failed)?;
        tokio::fs::rename(&part.0, self.folder.join(sha256.as_str())).await.map_err(failed)?;
        let folder = self.folder.clone();
        let synced = tokio::task::spawn_blocking(move || sync_folder(&folder)).await;
        Ok(synced.map_err(io::Error::other).and_then(|it| it).map_err(failed)?)
    }

    /// Returns the answer with a file.
    pub(crate) async fn send(&self, sha256: &Sha256) -> CloudResult<Response> {
        let file = File::open(self.folder.join(sha256.as_str())).await;
        let file = match file {
            Ok(file) => file,
            Err(_) => {
                let help = "deploy the revision again, which sends missing files";
                return Err(CloudError::missing(format!("the file {sha256} is missing"), help));
            }
        };
        let failed = |error| {
            Failure::caused_by(Exit::Internal, format!("cannot send the file {sha256}"), &error)
        };
        let length = file.metadata().await.map_err(failed)?.len();
        let headers = [(header::CONTENT_LENGTH, length.to_string()), octets()];
        Ok((headers, body_of(file)).into_response())
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
