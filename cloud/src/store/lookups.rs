//! Lookups of many connections by few queries: after a restart, and with a deployment, all vehicles
//! of a fleet need the same at once. A query for each would wake a thread of the database, and
//! another one for its row, ten thousand times.

use std::collections::{BTreeSet, HashMap};

use tokio::sync::{mpsc, oneshot};

use super::writer::stopped;
use crate::error::CloudResult;
use crate::sqlx::AnyPool;

const GROUP_MAX: usize = 256;

/// The certificates, with their ends and vehicles.
pub(super) const CERTIFICATES: &str = "SELECT sha256, expires, vehicles.name FROM certificates
     JOIN vehicles ON vehicles.name = certificates.vehicle
     WHERE is_revoked = 0 AND sha256 IN ($1..)";
/// The vehicles, with the numbers and digests of their desired states; after the digest, [`AHEAD`]
/// of one that has followed a newer state.
pub(super) const WANTS: &str = "SELECT name, generation,
     CASE WHEN is_ahead = 0 THEN digest ELSE digest || ' ahead' END
     FROM vehicles WHERE is_revoked = 0 AND name IN ($1..)";
pub(super) const AHEAD: &str = " ahead";
pub(super) const ENVELOPES: &str =
    "SELECT sha256, number, envelope FROM releases WHERE sha256 IN ($1..)";
pub(super) const REVISIONS: &str =
    "SELECT digest, unused_since, envelope FROM revisions WHERE digest IN ($1..)";

type FoundRow = (i64, String);

struct Lookup {
    key: String,
    reply: oneshot::Sender<CloudResult<Option<FoundRow>>>,
}

pub(super) struct LookupQueue(mpsc::Sender<Lookup>);

impl LookupQueue {
    /// Starts the task that looks up, which ends with the queue. `sql` is a query of a key, a
    /// number and a text.
    pub(super) fn start(pool: &AnyPool, sql: &'static str) -> Self {
        let (queue, waiting) = mpsc::channel(GROUP_MAX);
        tokio::spawn(run(pool.clone(), sql, waiting));
        Self(queue)
    }

    /// Looks up with others; returns what the database has at a time after the call. The key is a
    /// text that every database can compare.
    pub(super) async fn find(&self, key: &str) -> CloudResult<Option<FoundRow>> {
        let (reply, found) = oneshot::channel();
        self.0.send(Lookup { key: key.to_owned(), reply }).await.map_err(|_| stopped())?;
        found.await.map_err(|_| stopped())?
    }
}

async fn run(pool: AnyPool, sql: &'static str, mut waiting: mpsc::Receiver<Lookup>) {
    let mut group = Vec::new();
    while waiting.recv_many(&mut group, GROUP_MAX).await > 0 {
        let keys: BTreeSet<_> = group.iter().map(|lookup| &*lookup.key).collect();
        let found = found(pool.clone(), sql, &keys.into_iter().collect::<Vec<_>>()).await;
        for Lookup { key, reply } in group.drain(..) {
            // The connection may have ended meanwhile.
            let _ = reply.send(match &found {
                Ok(rows) => Ok(rows.get(&key).cloned()),
                Err(error) => Err(error.clone()),
            });
        }
    }
}

async fn found(pool: AnyPool, sql: &str, keys: &[&str]) -> CloudResult<HashMap<String, FoundRow>> {
    let rows: Vec<(String, i64, String)> = rows_in!(&pool; sql; keys);
    Ok(rows.into_iter().map(|(key, number, text)| (key, (number, text))).collect())
}
