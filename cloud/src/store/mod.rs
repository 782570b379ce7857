//! The database: what must survive a restart, apart from files.
//!
//! All SQL is in this room, in the dialect that SQLite and PostgreSQL share. Changes wait for their
//! turn, so that SQLite has one writer in this process. A change of a person is one transaction,
//! with its entry of the audit trail; `writer` commits what vehicles send together.

#[macro_use]
mod sql;

mod address;
mod age_clock;
mod append;
mod audit;
mod chunks;
mod cleaning;
mod clip_list;
mod clip_quotas;
mod clips;
mod counting;
mod deployments;
mod links;
mod live_streams;
mod lookups;
mod numbers;
mod page;
mod record_age;
mod records;
mod replicas;
mod requests;
mod secrets;
#[cfg(test)]
pub(crate) mod tests;
mod tokens;
mod users;
mod vehicles;
mod wants;
mod waves;
mod writer;

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure};
use tokio::sync::{Mutex, MutexGuard};

use self::age_clock::AgeClock;
use self::lookups::LookupQueue;
use self::wants::WantedStates;
use self::writer::WriteQueue;
use crate::error::{CloudError, CloudResult};
use crate::sqlx::{self, Any, AnyPool, Transaction};

pub(crate) use address::StoreAddress;
pub(crate) use chunks::{ChunkSizes, KeptLine, StoredChunk};
pub(crate) use cleaning::RemovedClip;
pub(crate) use clip_list::ClipQuery;
pub(crate) use clip_quotas::ClipBounds;
pub(crate) use clips::{ClipProgress, StoredPart};
pub(crate) use deployments::OfferedDeployment;
pub(crate) use links::VehicleReport;
pub(crate) use live_streams::VehicleTail;
pub(crate) use numbers::NUMBER_MAX;
pub(crate) use page::{LINE_MAX, NewestRecords, VehicleFilter, VehiclePage, large_line};
pub(crate) use records::{RecordPage, Retention, StreamBatch, name_in_lines};
pub(crate) use replicas::OwnLink;
pub(crate) use requests::{ChangeAuthor, RequestKey};
#[cfg(test)]
pub(crate) use tests::address;
pub(crate) use tokens::{TOKENS_MAX, TokenUser};
pub(crate) use users::CONSOLE;
pub(crate) use vehicles::Issued;

macro_rules! migrations {
    ($($name:literal),+) => {
        &[$(include_str!(concat!("../../migrations/", $name, ".sql"))),+]
    };
}

/// The migrations, oldest first: the version of a database is the number of those that it has.
/// Deployed ones count them in a table of their own, and `sqlx::migrate!`, which keeps checksums in
/// another one, would run the first of them again.
pub(crate) const MIGRATIONS: &[&str] = migrations! {
    "0001_start", "0002_releases", "0003_clips", "0004_page", "0006_replicas", "0007_requests",
    "0008_cleaning", "0009_tokens", "0010_chunks", "0011_tails", "0012_clip_parts",
    "0013_reported_envelopes", "0014_lives", "0015_age_clock", "0016_fallbacks", "0017_clip_bytes"
};

const DAY_S: i64 = 86_400;

/// Maximum number of queries at a time: with more threads than cores, each only takes longer.
const QUERIES_MAX: u32 = 4;

pub(crate) struct CloudStore {
    /// Connections of queries.
    pool: AnyPool,
    /// The connection of changes: they do not wait behind the queries of a whole fleet.
    changes: AnyPool,
    /// The statement that begins a change, for one at a time.
    turn: Arc<Mutex<&'static str>>,
    writes: WriteQueue,
    /// Lookups of certificates, desired states, and envelopes of deployments and revisions.
    certificates: LookupQueue,
    wants: LookupQueue,
    envelopes: LookupQueue,
    revisions: LookupQueue,
    wanted: WantedStates,
    ages: AgeClock,
    is_file: bool,
    /// Name of this process among those that serve the database.
    replica: String,
}

/// A change that is not committed yet; dropped, it is undone.
pub(crate) struct StoreChange<'s> {
    tx: Transaction<'static, Any>,
    _turn: MutexGuard<'s, &'static str>,
}

impl CloudStore {
    /// Opens the database, and brings it to the newest version.
    /// Fails if it cannot be opened, or a later version of the program has made it.
    pub(crate) async fn open(address: &StoreAddress) -> Result<Self, Failure> {
        Self::opened(address, false).await
    }

    /// Opens a database that may be in use by a running cloud.
    /// Fails if it cannot be opened, or is of another version: brought to a newer one, it could not
    /// be used by that cloud any more.
    pub(crate) async fn in_use(address: &StoreAddress) -> Result<Self, Failure> {
        Self::opened(address, true).await
    }

    async fn opened(address: &StoreAddress, in_use: bool) -> Result<Self, Failure> {
        let (changes, pool) = (address.connect(1).await?, address.connect(QUERIES_MAX).await?);
        let turn = Arc::new(Mutex::new(address.begin()));
        let writes = WriteQueue::start(changes.clone(), Arc::clone(&turn));
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(|error| {
            Failure::caused_by(Exit::Internal, "no random numbers can be made", &error)
        })?;
        let store = Self {
            certificates: LookupQueue::start(&pool, lookups::CERTIFICATES),
            wants: LookupQueue::start(&pool, lookups::WANTS),
            envelopes: LookupQueue::start(&pool, lookups::ENVELOPES),
            revisions: LookupQueue::start(&pool, lookups::REVISIONS),
            pool,
            changes,
            turn,
            writes,
            wanted: WantedStates::default(),
            ages: AgeClock::start(),
            is_file: matches!(address, StoreAddress::Sqlite(_)),
            replica: gleaner_base::hex(&bytes),
        };
        store.migrate(in_use).await?;
        store.count_age().await?;
        Ok(store)
    }

    async fn migrate(&self, in_use: bool) -> CloudResult<()> {
        let mut change = self.change().await?;
        sqlx::raw_sql("CREATE TABLE IF NOT EXISTS migrations (version BIGINT PRIMARY KEY)")
            .execute(&mut *change.tx)
            .await?;
        let version: u64 = one!(change; "SELECT COALESCE(MAX(version), 0) FROM migrations");
        let (version, newest) = (version as usize, MIGRATIONS.len());
        if version > newest || in_use && version < newest {
            let message = format!("the database has version {version}; this program has {newest}");
            let help = match version > newest {
                true => "start the version of gleaner-cloud that made it, or a later one",
                false => "use the gleaner-cloud that made it; `serve` of this one upgrades it",
            };
            return Err(CloudError::usage(message, help));
        }
        for (index, sql) in MIGRATIONS.iter().enumerate().skip(version) {
            sqlx::raw_sql(*sql).execute(&mut *change.tx).await?;
            run!(change; "INSERT INTO migrations (version) VALUES ($1)"; index + 1);
        }
        change.commit().await
    }

    pub(crate) async fn version(&self) -> CloudResult<i64> {
        Ok(one!(self; "SELECT MAX(version) FROM migrations"))
    }

    /// Begins a change, once no other one is in progress.
    pub(crate) async fn change(&self) -> CloudResult<StoreChange<'_>> {
        begin(&self.changes, &self.turn).await
    }

    /// Ties a database on a server to this authority and this place of files, the first time.
    /// `authority` is `None` if the folder has none yet: then an empty database is left as it is.
    /// Fails if it belongs to another authority, as its vehicles would not accept this cloud, or
    /// has its files elsewhere.
    pub(crate) async fn tie(&self, authority: Option<&str>, objects: &str) -> CloudResult<()> {
        if self.is_file {
            return Ok(());
        }
        let mut change = self.change().await?;
        let row: Option<(String, String)> = row!(change; "SELECT authority, objects FROM folder");
        match (row, authority) {
            (Some((stored, _)), _) if Some(&*stored) != authority => {
                let message = "the database of --store belongs to another data folder";
                let help = "serve the folder that it was made with, put a copy of its folder `ca` \
                            in the place of this one's, or name an empty database";
                Err(CloudError::usage(message, help))
            }
            (Some((_, stored)), _) if stored != objects => {
                let place = if stored.is_empty() { "the data folder" } else { &stored };
                let message = format!("the files of the database of --store are in {place}");
                let help = "start with the --objects that it was made with, or without";
                Err(CloudError::usage(message, help))
            }
            (Some(_), _) | (None, None) => Ok(()),
            (None, Some(authority)) => {
                run!(change;
                    "INSERT INTO folder (authority, objects) VALUES ($1, $2)"; authority, objects);
                change.commit().await
            }
        }
    }

    /// Writes a copy of the database to a new file.
    pub(crate) async fn copy_to(&self, file: &str) -> CloudResult<()> {
        if !self.is_file {
            let message = "the database is on a PostgreSQL server, which copies it itself";
            return Err(CloudError::usage(message, "use `pg_dump`, and copy the data folder, too"));
        }
        run!(self; "VACUUM INTO $1"; file);
        Ok(())
    }

    /// Closes the database, once open changes have ended.
    pub(crate) async fn close(&self) {
        self.changes.close().await;
        self.pool.close().await;
    }
}

impl StoreChange<'_> {
    pub(crate) async fn commit(self) -> CloudResult<()> {
        Ok(self.tx.commit().await?)
    }
}

async fn begin<'s>(pool: &AnyPool, turn: &'s Mutex<&'static str>) -> CloudResult<StoreChange<'s>> {
    let turn = turn.lock().await;
    let tx = pool.begin_with(*turn).await?;
    Ok(StoreChange { tx, _turn: turn })
}

pub(crate) fn now() -> i64 {
    now_ms() / 1000
}

pub(crate) fn now_ms() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_millis()).unwrap_or(i64::MAX)
}

/// Converts a number for the database, which has no unsigned ones. Numbers from outside are checked
/// before, by `numbers`, but for positions and lengths of lists: nothing is beyond the largest one.
fn int(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

fn unsigned(number: i64) -> u64 {
    u64::try_from(number).unwrap_or(0)
}
