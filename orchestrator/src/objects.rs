//! Receives files that deployments need, from users.

use std::error::Error;
use std::io;

use axum::body::Bytes;
use futures_util::{Stream, StreamExt};
use gleaner_base::{Exit, Failure};
use gleaner_fleet::{AnnouncedFile, UnfinishedFile};
use gleaner_lambda::manifest::Sha256;
use tokio::io::AsyncWriteExt;

use crate::orchestrator::Orchestrator;
use crate::store::begin_object;

/// Receives the file with the digest `wanted`, if a deployment needs it. It counts only if its
/// digest is right.
pub(crate) async fn receive<E: Error + Send + Sync + 'static>(
    core: &Orchestrator,
    wanted: &Sha256,
    mut pieces: impl Stream<Item = Result<Bytes, E>> + Unpin,
) -> Result<(), Failure> {
    let length = core.expected(wanted)?;
    let path = core.store.object(wanted);
    let failed = |error: io::Error| {
        Failure::caused_by(Exit::Internal, format!("cannot receive the file {wanted}"), &error)
    };
    let refused = |why: String| {
        let mut failure = Failure::new(Exit::Denied, format!("the file {wanted} is refused"));
        failure.causes = vec![why];
        failure
    };
    let (file, part) = begin_object(&path).map_err(failed)?;
    let part = UnfinishedFile(part);
    let mut file = tokio::fs::File::from_std(file);
    let mut announced = AnnouncedFile::new(length);
    while let Some(piece) = pieces.next().await {
        let piece = piece.map_err(|error| failed(io::Error::other(error)))?;
        announced.add(&piece).map_err(refused)?;
        file.write_all(&piece).await.map_err(failed)?;
    }
    announced.finish(wanted.as_str()).map_err(refused)?;
    // The last write goes on in the background, and only this returns its error.
    file.flush().await.map_err(failed)?;
    file.sync_all().await.map_err(failed)?;
    tokio::fs::rename(&part.0, &path).await.map_err(failed)
}
