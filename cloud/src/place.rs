//! Places of files: a folder of this process, or a bucket of an object store that several replicas
//! share. A file appears under its name only once it is complete and durable.

use std::io::{self, SeekFrom};
use std::path::{Path, PathBuf};

use axum::body::Body;
use gleaner_base::{Failure, sync_folder};
use gleaner_fleet::UnfinishedFile;
use tokio::fs::File;
use tokio::io::AsyncSeekExt;

use crate::folder::remove_parts;
use crate::scaled::S3Bucket;
use crate::transfer::body_of;

/// Number of lists, of a thousand names each, that the removal of a file takes at most.
const LISTS_MAX: usize = 100;

#[derive(Debug)]
pub(crate) struct FilePlace {
    /// Folder in which files are received, and stay without a bucket.
    folder: PathBuf,
    /// The bucket, and the beginning of the names in it.
    bucket: Option<(S3Bucket, &'static str)>,
}

impl FilePlace {
    /// Opens a folder, and removes what an earlier process has left unfinished there. With a
    /// bucket, files are kept in it, under names that begin with `start`.
    /// A failure names the folder.
    pub(crate) fn open(
        folder: PathBuf,
        bucket: Option<&S3Bucket>,
        start: &'static str,
    ) -> Result<Self, Failure> {
        remove_parts(&folder)?;
        Ok(Self { folder, bucket: bucket.map(|bucket| (bucket.clone(), start)) })
    }

    /// Returns the folder in which files are received.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    pub(crate) fn is_bucket(&self) -> bool {
        self.bucket.is_some()
    }

    /// Keeps a received file under a name, durable.
    pub(crate) async fn keep(&self, part: &UnfinishedFile, name: &str) -> io::Result<()> {
        if let Some((bucket, start)) = &self.bucket {
            return bucket.put(&format!("{start}{name}"), &part.0).await;
        }
        let (from, to, folder) = (part.0.clone(), self.folder.join(name), self.folder.clone());
        blocking(move || {
            std::fs::File::open(&from)?.sync_all()?;
            std::fs::rename(from, to)?;
            sync_folder(&folder)
        })
        .await
    }

    pub(crate) async fn length(&self, name: &str) -> io::Result<Option<u64>> {
        match &self.bucket {
            Some((bucket, start)) => bucket.length(&format!("{start}{name}")).await,
            None => {
                Ok(found(tokio::fs::metadata(self.folder.join(name)).await)?.map(|it| it.len()))
            }
        }
    }

    /// Returns the content of a file from the byte `begin` on, if it is there.
    pub(crate) async fn content(&self, name: &str, begin: u64) -> io::Result<Option<Body>> {
        if let Some((bucket, start)) = &self.bucket {
            return bucket.content(&format!("{start}{name}"), begin).await;
        }
        let file = found(File::open(self.folder.join(name)).await)?;
        let Some(mut file) = file else { return Ok(None) };
        file.seek(SeekFrom::Start(begin)).await?;
        Ok(Some(body_of(file)))
    }

    /// Removes a file, and in a bucket those whose names begin with its own and a `/`.
    pub(crate) async fn remove(&self, name: &str) -> io::Result<()> {
        let Some((bucket, start)) = &self.bucket else {
            return found(tokio::fs::remove_file(self.folder.join(name)).await).map(drop);
        };
        let name = format!("{start}{name}");
        bucket.remove(&name).await?;
        let start = format!("{name}/");
        // Of each kind, a file has few: a store that lists them forever must not keep this busy.
        for _ in 0..LISTS_MAX {
            let names = bucket.list(&start).await?;
            if names.is_empty() {
                return Ok(());
            }
            for name in names {
                bucket.remove(&name).await?;
            }
        }
        Err(io::Error::other(format!("the object store still lists names under `{start}`")))
    }
}

/// Returns the result of an access to a file, or `None` if there is none.
fn found<T>(result: io::Result<T>) -> io::Result<Option<T>> {
    match result {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        result => result.map(Some),
    }
}

pub(crate) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> io::Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(io::Error::other)?
}
