//! Files of revisions, by their SHA-256. A file appears under its digest only when it is complete
//! and durable, and is never changed afterwards.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use axum::body::Body;
use axum::http::HeaderMap;
use axum::response::Response;
use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::bounds::MANIFEST_MAX;
use gleaner_lambda::manifest::{MANIFEST_FILE, Sha256};
use gleaner_protocol::vehicle_api::MissingObject;
use gleaner_trust::Revision;
use tokio::sync::RwLock;
use tokio::time::interval;

use crate::error::{CloudError, CloudResult};
use crate::folder::PART;
use crate::place::{FilePlace, blocking};
use crate::store::CloudStore;
use crate::transfer::{IncomingFile, OCTETS, OutgoingFile, PIECE_TIME};

/// Interval of looks for revisions and files that no release needs.
const COLLECTING: Duration = Duration::from_secs(3600);
/// Time for which they are kept: files are sent before their deployment is.
const GRACE: Duration = Duration::from_secs(86_400);

/// Removes revisions and files that no release needs, for as long as the program runs.
pub(crate) async fn collect(objects: &Objects, store: &CloudStore) {
    let mut looks = interval(COLLECTING);
    loop {
        looks.tick().await;
        if let Err(error) = collect_once(objects, store, GRACE).await {
            tracing::warn!(reason = error.reason(), "could not delete unused files; will retry");
        }
    }
}

async fn collect_once(objects: &Objects, store: &CloudStore, grace: Duration) -> CloudResult<()> {
    let grace_s = i64::try_from(grace.as_secs()).unwrap_or(i64::MAX);
    let revisions = store.collect_revisions(grace_s).await?;
    let files = objects.collect(store, grace).await?;
    if revisions > 0 || files > 0 {
        tracing::info!(revisions, files, "deleted unreferenced artifacts");
    }
    Ok(())
}

/// All files.
#[derive(Debug)]
pub(crate) struct Objects {
    place: FilePlace,
    parts: AtomicU64,
    /// Held for reading from the look for missing files until the deployment is stored, and for
    /// writing while unused files are removed.
    pub(crate) uses: RwLock<()>,
}

impl Objects {
    pub(crate) fn new(place: FilePlace) -> Self {
        Self { place, parts: AtomicU64::new(0), uses: RwLock::default() }
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

    /// Removes files of the folder that are older than `grace` and that no revision names; returns
    /// their number. A bucket keeps its files: other replicas may use them at this moment.
    async fn collect(&self, store: &CloudStore, grace: Duration) -> CloudResult<u64> {
        if self.place.is_bucket() {
            return Ok(0);
        }
        let _uses = self.uses.write().await;
        let Some(used) = store.used_objects().await? else { return Ok(0) };
        let folder = self.place.folder().to_owned();
        Ok(blocking(move || remove_unused(&folder, &used, grace)).await.map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot remove unused files", &error)
        })?)
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
        let path = self.place.folder().join(format!("{sha256}.{number}.{PART}"));
        let name = format!("the file {sha256}");
        let file = IncomingFile { name: &name, length };
        let part = file.receive(sha256.as_str(), PIECE_TIME, path, body).await?;
        Ok(self.place.keep(&part, sha256.as_str()).await.map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot store {name}"), &error)
        })?)
    }

    pub(crate) async fn manifest(&self, revision: &Revision) -> CloudResult<String> {
        let mut files = revision.files.iter();
        let file = files.find(|file| file.path.as_str() == MANIFEST_FILE);
        let Some(file) = file.filter(|file| file.bytes <= MANIFEST_MAX.bytes()) else {
            let message = format!("a revision of `{}` has no manifest that fits", revision.name);
            return Err(CloudError::usage(message, "build and publish the lambda again"));
        };
        let failed = |error: io::Error| {
            let action = format!("cannot read the manifest {}", file.sha256);
            Failure::caused_by(Exit::Internal, action, &error)
        };
        let content = self.place.content(file.sha256.as_str(), 0).await.map_err(failed)?;
        let content = content.ok_or_else(|| failed(io::ErrorKind::NotFound.into()))?;
        let most = usize::try_from(file.bytes).unwrap_or(usize::MAX);
        let bytes = axum::body::to_bytes(content, most).await;
        let bytes = bytes.map_err(|error| failed(io::Error::other(error)))?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }

    /// Returns the answer with a file, or with the end of it.
    pub(crate) async fn send(
        &self,
        slot: impl Send + 'static,
        sha256: &Sha256,
        headers: &HeaderMap,
    ) -> CloudResult<Response> {
        let name = format!("the file {sha256}");
        let help = "deploy the revision again, which sends missing files";
        let length = self.place.length(sha256.as_str()).await;
        let content = async |begin| self.place.content(sha256.as_str(), begin).await;
        let sha256 = Some(sha256.as_str());
        OutgoingFile { name: &name, kind: OCTETS, help, sha256 }
            .send(slot, headers, length, content)
            .await
    }
}

fn remove_unused(folder: &Path, used: &BTreeSet<String>, grace: Duration) -> io::Result<u64> {
    let mut removed = 0;
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        // One that is being received is not whole, and may have gone meanwhile.
        if path.extension().is_some() || used.contains(name) {
            continue;
        }
        let changed = path.metadata().and_then(|found| found.modified())?;
        // After a jump of the clock it stays.
        if changed.elapsed().is_ok_and(|age| age >= grace) {
            fs::remove_file(&path)?;
            removed += 1;
        }
    }
    Ok(removed)
}

#[cfg(test)]
mod tests {
    use std::fs::{File, FileTimes};
    use std::time::SystemTime;

    use tempfile::TempDir;

    use super::*;

    #[test]
    fn only_old_files_that_nothing_needs_are_removed() {
        let folder = TempDir::new().unwrap();
        let old = SystemTime::now() - Duration::from_secs(90_000);
        for (name, is_old) in [("used", true), ("new", false), ("x.1.part", true), ("old", true)] {
            let file = File::create(folder.path().join(name)).unwrap();
            if is_old {
                file.set_times(FileTimes::new().set_modified(old)).unwrap();
            }
        }
        let used = ["used".to_owned()].into();
        assert_eq!(remove_unused(folder.path(), &used, GRACE).unwrap(), 1);
        let left = ["used", "new", "x.1.part", "old"].map(|it| folder.path().join(it).exists());
        assert_eq!(left, [true, true, true, false]);
    }
}
