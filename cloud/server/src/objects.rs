//! Files of revisions, by their SHA-256. A file appears under its digest only when it is complete
//! and durable, and is never changed afterwards.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use axum::body::Body;
use axum::http::HeaderMap;
use axum::response::Response;
use gleaner_base::{Exit, Failure, sync_folder};
use gleaner_lambda::manifest::Sha256;
use gleaner_protocol::vehicle_api::MissingObject;
use gleaner_trust::Revision;
use tokio::sync::RwLock;
use tokio::time::interval;

use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};
use crate::folder::{PART, remove_parts};
use crate::transfer::{IncomingFile, OCTETS, OutgoingFile};

/// Maximum number of deployments that wait for files.
const OFFERS_MAX: usize = 64;

/// Interval of looks for revisions and files that no release needs.
const COLLECTING: Duration = Duration::from_secs(3600);
/// Time for which they are kept: files are sent before their deployment is.
const GRACE: Duration = Duration::from_secs(86_400);

/// Removes revisions and files that no release needs, for as long as the program runs.
pub(crate) async fn collect(cloud: &Cloud) {
    let mut looks = interval(COLLECTING);
    loop {
        looks.tick().await;
        if let Err(error) = collect_once(cloud, GRACE).await {
            tracing::warn!(reason = error.reason(), "unused files are not removed");
        }
    }
}

async fn collect_once(cloud: &Cloud, grace: Duration) -> CloudResult<()> {
    let grace_s = i64::try_from(grace.as_secs()).unwrap_or(i64::MAX);
    let revisions = cloud.store.collect_revisions(grace_s).await?;
    let _uses = cloud.objects.uses.write().await;
    let Some(used) = cloud.store.used_objects().await? else { return Ok(()) };
    let files = cloud.objects.collect(&used, grace).map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot remove unused files", &error)
    })?;
    if revisions > 0 || files > 0 {
        tracing::info!(revisions, files, "what no release needs was removed");
    }
    Ok(())
}

/// The folder of files.
#[derive(Debug)]
pub(crate) struct Objects {
    folder: PathBuf,
    /// Files that offered deployments need, by the id of the deployment.
    offers: Mutex<BTreeMap<String, Vec<MissingObject>>>,
    parts: AtomicU64,
    /// Held for reading from the look for missing files until the deployment is stored, and for
    /// writing while unused files are removed.
    pub(crate) uses: RwLock<()>,
}

impl Objects {
    /// Opens the folder, and removes what an earlier process left unfinished.
    ///
    /// # Errors
    ///
    /// A failure that names the folder.
    pub(crate) fn open(folder: PathBuf) -> Result<Self, Failure> {
        remove_parts(&folder)?;
        Ok(Self {
            folder,
            offers: Mutex::default(),
            parts: AtomicU64::new(0),
            uses: RwLock::default(),
        })
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

    /// Removes files that are older than `grace` and not among `used`; returns their number.
    pub(crate) fn collect(&self, used: &BTreeSet<String>, grace: Duration) -> io::Result<u64> {
        let mut removed = 0;
        for entry in fs::read_dir(&self.folder)? {
            let path = entry?.path();
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let changed = path.metadata().and_then(|found| found.modified())?;
            // After a jump of the clock it stays.
            let is_old = changed.elapsed().is_ok_and(|age| age >= grace);
            let is_whole = path.extension().is_none();
            if is_whole && is_old && !used.contains(name) {
                fs::remove_file(&path)?;
                removed += 1;
            }
        }
        Ok(removed)
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
        let path = self.folder.join(format!("{sha256}.{number}.{PART}"));
        let name = format!("the file {sha256}");
        let file = IncomingFile { name: &name, length, sha256: sha256.as_str() };
        let part = file.receive(path, body).await?;
        let (folder, whole) = (self.folder.clone(), self.folder.join(sha256.as_str()));
        let kept = tokio::task::spawn_blocking(move || {
            File::open(&part.0)?.sync_all()?;
            fs::rename(&part.0, whole)?;
            sync_folder(&folder)
        });
        let kept = kept.await.map_err(io::Error::other).and_then(|it| it);
        Ok(kept.map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot store {name}"), &error)
        })?)
    }

    /// Returns the answer with a file, or with the end of it.
    pub(crate) async fn send(&self, sha256: &Sha256, headers: &HeaderMap) -> CloudResult<Response> {
        let (path, name) = (self.folder.join(sha256.as_str()), format!("the file {sha256}"));
        let help = "deploy the revision again, which sends missing files";
        OutgoingFile { path: &path, name: &name, kind: OCTETS, help }.send(headers).await
    }
}

#[cfg(test)]
mod tests {
    use std::fs::FileTimes;
    use std::time::SystemTime;

    use tempfile::TempDir;

    use super::*;

    #[test]
    fn only_old_files_that_nothing_needs_are_removed() {
        let folder = TempDir::new().unwrap();
        let objects = Objects::open(folder.path().to_owned()).unwrap();
        let old = SystemTime::now() - Duration::from_secs(90_000);
        for (name, is_old) in [("used", true), ("new", false), ("x.1.part", true), ("old", true)] {
            let file = File::create(folder.path().join(name)).unwrap();
            if is_old {
                file.set_times(FileTimes::new().set_modified(old)).unwrap();
            }
        }
        assert_eq!(objects.collect(&["used".to_owned()].into(), GRACE).unwrap(), 1);
        let left = ["used", "new", "x.1.part", "old"].map(|it| folder.path().join(it).exists());
        assert_eq!(left, [true, true, true, false]);
    }
}
