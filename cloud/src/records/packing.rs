//! Moves old records into chunks, and removes those that are too old.

use std::time::Duration;

use gleaner_base::{Exit, Failure};
use tokio::time::interval;

use super::{RecordArchive, chunk};
use crate::error::CloudResult;
use crate::place::blocking;
use crate::store::ChunkSizes;

/// Interval of looks for records to move or to remove.
const LOOKS: Duration = Duration::from_secs(60);
/// Time within which a chunk is made. Its file is removed afterwards, if it was not.
const GRACE_S: i64 = 3600;

/// Moves records into chunks and removes old ones, for as long as the program runs.
pub(crate) async fn keep(archive: &RecordArchive) {
    let mut looks = interval(LOOKS);
    loop {
        looks.tick().await;
        if let Err(error) = pack(archive, ChunkSizes::DEFAULT).await {
            tracing::warn!(reason = error.reason(), "packing old records failed; will retry");
        }
        if let Err(error) = remove_old(archive, GRACE_S).await {
            tracing::warn!(reason = error.reason(), "could not delete old records; will retry");
        }
    }
}

/// Maximum number of chunks of a stream that are made one after the other.
const CHUNKS_AT_ONCE: usize = 64;
/// Number of streams with failures after which others wait for the next look: then it is probably
/// the database or the place of the files that fails.
const FAILURES_MAX: usize = 8;

/// Moves the oldest records of each stream that has many into chunks; returns their number.
///
/// # Errors
///
/// An error once many streams cannot be packed. Below that, each is logged, and the others go on.
pub(super) async fn pack(archive: &RecordArchive, sizes: ChunkSizes) -> CloudResult<u64> {
    let (mut made, mut failures) = (0, 0);
    for (vehicle, stream) in archive.store.packable(sizes).await? {
        // A stream that grows faster keeps no other one waiting.
        for _ in 0..CHUNKS_AT_ONCE {
            match pack_stream(archive, (&vehicle, &stream), sizes).await {
                Ok(true) => made += 1,
                Ok(false) => break,
                Err(error) => {
                    failures += 1;
                    if failures == FAILURES_MAX {
                        return Err(error);
                    }
                    let reason = error.reason();
                    tracing::warn!(vehicle, stream, reason, "could not pack a stream; will retry");
                    break;
                }
            }
        }
    }
    if made > 0 {
        tracing::debug!(chunks = made, "packed old records into chunks");
    }
    Ok(made)
}

/// Moves the oldest records of a stream into a chunk. Returns false if there are not enough, or
/// another process has moved them meanwhile.
async fn pack_stream(
    archive: &RecordArchive,
    of: (&str, &str),
    sizes: ChunkSizes,
) -> CloudResult<bool> {
    let lines = archive.store.oldest_lines(of, sizes).await?;
    if lines.is_empty() {
        return Ok(false);
    }
    let failed = |error| {
        let action = format!("cannot store a chunk of `{}` of vehicle `{}`", of.1, of.0);
        Failure::caused_by(Exit::Internal, action, &error)
    };
    let names = (of.0.to_owned(), of.1.to_owned());
    let encode = move || chunk::encode((&names.0, &names.1), &lines);
    let (chunk, file) = blocking(encode).await.map_err(failed)?;
    archive.store.note_chunk_file(&chunk.sha256).await?;
    archive.chunks.keep(&chunk.sha256, file).await.map_err(failed)?;
    archive.store.pack(of, &chunk).await
}

/// Removes records that are too old, and the files of all chunks that are not needed.
pub(super) async fn remove_old(archive: &RecordArchive, grace_s: i64) -> CloudResult<()> {
    archive.store.count_age().await?;
    if archive.keep_days > 0 {
        archive.store.note_arrivals().await?;
        while archive.store.expire_records(archive.keep_days).await? {}
    }
    let mut removed = Vec::new();
    for sha256 in archive.store.unneeded_chunk_files(grace_s).await? {
        match archive.chunks.remove(&sha256).await {
            Ok(()) => removed.push(sha256),
            Err(error) => {
                tracing::warn!(sha256, %error, "could not delete a chunk file; will retry")
            }
        }
    }
    if removed.is_empty() {
        return Ok(());
    }
    archive.store.forget_chunk_files(&removed).await
}
