//! The database: what must survive a restart, apart from files.
//!
//! All SQL is in this room, in the dialect that SQLite and PostgreSQL share. Changes wait for their
//! turn, so that SQLite has one writer in this process. A change of a person is one transaction,
//! with its entry of the audit trail; `writer` commits what vehicles send together.

/// Runs a statement with these values; returns its result.
macro_rules! run {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        crate::sqlx::query($sql)$($(.bind($value))+)?.execute($on).await?
    };
}

/// Runs a query with these values; returns its row, if there is one.
macro_rules! row {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        crate::sqlx::query_as($sql)$($(.bind($value))+)?.fetch_optional($on).await?
    };
}

/// Runs a query with these values; returns its only row.
macro_rules! one {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        crate::sqlx::query_as($sql)$($(.bind($value))+)?.fetch_one($on).await?
    };
}

/// Runs a query with these values; returns its rows.
macro_rules! rows {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        crate::sqlx::query_as($sql)$($(.bind($value))+)?.fetch_all($on).await?
    };
}

/// Runs a query with `IN ()` for these values, its only ones, 256 at a time; returns all rows. An
/// order or a group is one of each part, and a value that comes twice may bring its rows twice.
macro_rules! rows_in {
    ($on:expr; $sql:expr; $values:expr) => {{
        let mut rows = Vec::new();
        for part in crate::store::list_parts($values) {
            let list = format!("IN ({})", crate::store::in_list(part.len()));
            let sql = crate::sqlx::AssertSqlSafe($sql.replace("IN ()", &list));
            let query = crate::sqlx::query_as(sql);
            let query = part.iter().fold(query, |query, value| query.bind(*value));
            rows.append(&mut query.fetch_all($on).await?);
        }
        rows
    }};
}

mod address;
mod age_clock;
mod append;
mod audit;
mod awaited;
mod chunks;
mod cleaning;
mod clip_list;
mod clip_quotas;
mod clips;
mod deployments;
mod links;
mod lookups;
mod numbers;
mod page;
mod record_age;
mod records;
mod replicas;
mod requests;
mod secrets;
mod tails;
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
use crate::sqlx::{self, Any, AnyPool, AssertSqlSafe, Transaction};

pub(crate) use address::StoreAddress;
pub(crate) use chunks::{ChunkSizes, KeptLine, StoredChunk};
pub(crate) use cleaning::RemovedClip;
pub(crate) use clip_list::ClipQuery;
pub(crate) use clip_quotas::ClipBounds;
pub(crate) use clips::{ClipProgress, StoredPart};
pub(crate) use deployments::OfferedDeployment;
pub(crate) use links::VehicleReport;
pub(crate) use numbers::NUMBER_MAX;
pub(crate) use page::{LINE_MAX, NewestRecords, VehicleFilter, VehiclePage, large_line};
pub(crate) use records::{RecordPage, Retention, StreamBatch, name_in_lines};
pub(crate) use replicas::OwnLink;
pub(crate) use requests::{ChangeAuthor, RequestKey};
pub(crate) use tails::VehicleTail;
#[cfg(test)]
pub(crate) use tests::address;
pub(crate) use tokens::{TOKENS_MAX, TokenUser};
pub(crate) use users::CONSOLE;
pub(crate) use vehicles::Issued;

/// The migrations, oldest first: the version of a database is the number of those that it has.
pub(crate) const MIGRATIONS: &[&str] = &[
    include_str!("../../migrations/0001_start.sql"),
    include_str!("../../migrations/0002_releases.sql"),
    include_str!("../../migrations/0003_clips.sql"),
    include_str!("../../migrations/0004_page.sql"),
    include_str!("../../migrations/0006_replicas.sql"),
    include_str!("../../migrations/0007_requests.sql"),
    include_str!("../../migrations/0008_cleaning.sql"),
    include_str!("../../migrations/0009_tokens.sql"),
    include_str!("../../migrations/0010_chunks.sql"),
    include_str!("../../migrations/0011_tails.sql"),
    include_str!("../../migrations/0012_clip_parts.sql"),
    include_str!("../../migrations/0013_reported_envelopes.sql"),
    include_str!("../../migrations/0014_lives.sql"),
    include_str!("../../migrations/0015_age_clock.sql"),
    include_str!("../../migrations/0016_fallbacks.sql"),
    include_str!("../../migrations/0017_clip_bytes.sql"),
];

const DAY_S: i64 = 86_400;

/// Maximum number of queries at a time: with more threads than cores, each only takes longer.
const QUERIES_MAX: u32 = 4;

/// The database.
pub(crate) struct CloudStore {
    /// Connections of queries.
    pool: AnyPool,
    /// The connection of changes: they do not wait behind the queries of a whole fleet.
    changes: AnyPool,
    /// The statement that begins a change, for one at a time.
    turn: Arc<Mutex<&'static str>>,
    writes: WriteQueue,
    /// Lookups of certificates, wanted states, and envelopes of deployments and revisions.
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
    ///
    /// # Errors
    ///
    /// A failure if it cannot be opened, or a later version of the program has made it.
    pub(crate) async fn open(address: &StoreAddress) -> Result<Self, Failure> {
        Self::opened(address, false).await
    }

    /// Opens a database that may be in use by a running cloud.
    ///
    /// # Errors
    ///
    /// A failure if it cannot be opened, or is of another version: brought to a newer one, it could
    /// not be used by that cloud any more.
    pub(crate) async fn in_use(address: &StoreAddress) -> Result<Self, Failure> {
        Self::opened(address, true).await
    }

    async fn opened(address: &StoreAddress, in_use: bool) -> Result<Self, Failure> {
        let (changes, pool) = (address.connect(1).await?, address.connect(QUERIES_MAX).await?);
        let turn = Arc::new(Mutex::new(address.begin()));
        let writes = WriteQueue::start(changes.clone(), Arc::clone(&turn));
        let is_file = matches!(address, StoreAddress::Sqlite(_));
        let wanted = WantedStates::default();
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(|error| {
            Failure::caused_by(Exit::Internal, "no random numbers can be made", &error)
        })?;
        let replica = gleaner_base::hex(&bytes);
        let store = Self {
            certificates: LookupQueue::start(&pool, lookups::CERTIFICATES),
            wants: LookupQueue::start(&pool, lookups::WANTS),
            envelopes: LookupQueue::start(&pool, lookups::ENVELOPES),
            revisions: LookupQueue::start(&pool, lookups::REVISIONS),
            pool,
            changes,
            turn,
            writes,
            wanted,
            ages: AgeClock::start(),
            is_file,
            replica,
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
        let (version,): (i64,) =
            one!(&mut *change.tx; "SELECT COALESCE(MAX(version), 0) FROM migrations");
        let newest = MIGRATIONS.len();
        let version = usize::try_from(version).unwrap_or(usize::MAX);
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
            let version = int(index as u64 + 1);
            run!(&mut *change.tx; "INSERT INTO migrations (version) VALUES ($1)"; version);
        }
        change.commit().await
    }

    pub(crate) async fn version(&self) -> CloudResult<i64> {
        let (version,): (i64,) = one!(&self.pool; "SELECT MAX(version) FROM migrations");
        Ok(version)
    }

    /// Begins a change, once no other one is in progress.
    pub(crate) async fn change(&self) -> CloudResult<StoreChange<'_>> {
        begin(&self.changes, &self.turn).await
    }

    /// Ties a database on a server to this authority and this place of files, the first time.
    /// `authority` is `None` if the folder has none yet: then an empty database is left as it is.
    ///
    /// # Errors
    ///
    /// An error if it belongs to another authority, as its vehicles would not accept this cloud, or
    /// has its files elsewhere.
    pub(crate) async fn tie(&self, authority: Option<&str>, objects: &str) -> CloudResult<()> {
        if self.is_file {
            return Ok(());
        }
        let mut change = self.change().await?;
        let row: Option<(String, String)> =
            row!(&mut *change.tx; "SELECT authority, objects FROM folder");
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
                run!(&mut *change.tx;
                    "INSERT INTO folder (authority, objects) VALUES ($1, $2)";
                    authority, objects);
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
        run!(&self.pool; "VACUUM INTO $1"; file);
        Ok(())
    }

    /// Closes the database, once open changes have ended.
    pub(crate) async fn close(&self) {
        self.changes.close().await;
        self.pool.close().await;
    }
}

impl StoreChange<'_> {
    /// Runs a statement that ends with `IN` for these values.
    async fn run_in<V: AsRef<str>>(&mut self, sql: &str, values: &[V]) -> CloudResult<()> {
        let values: Vec<_> = values.iter().map(AsRef::as_ref).collect();
        for part in list_parts(&values) {
            let sql = format!("{sql} ({})", in_list(part.len()));
            let query = sqlx::query(AssertSqlSafe(sql));
            let query = part.iter().fold(query, |query, value| query.bind(*value));
            query.execute(&mut *self.tx).await?;
        }
        Ok(())
    }

    /// Returns the placeholders of `rows` rows of so many values, the only ones of their statement.
    /// SQLite gets them without numbers: it searches a list of all numbers for each value.
    fn placeholders(&self, rows: usize, columns: usize) -> String {
        if self.tx.backend_name() == "SQLite" {
            let row = format!("(?{})", ", ?".repeat(columns - 1));
            return vec![row; rows].join(", ");
        }
        let row = |row| {
            let first = row * columns + 1;
            let all: Vec<_> = (first..first + columns).map(|it| format!("${it}")).collect();
            format!("({})", all.join(", "))
        };
        (0..rows).map(row).collect::<Vec<_>>().join(", ")
    }

    pub(crate) async fn commit(self) -> CloudResult<()> {
        Ok(self.tx.commit().await?)
    }
}

async fn begin<'s>(pool: &AnyPool, turn: &'s Mutex<&'static str>) -> CloudResult<StoreChange<'s>> {
    let turn = turn.lock().await;
    let tx = pool.begin_with(*turn).await?;
    Ok(StoreChange { tx, _turn: turn })
}

/// Returns the placeholders of the first `count` values, for a list.
fn in_list(count: usize) -> String {
    (1..=count).map(|number| format!("${number}")).collect::<Vec<_>>().join(", ")
}

/// Splits rows into parts of few different lengths: for each, a statement is prepared once.
fn parts<T>(mut rows: &[T]) -> impl Iterator<Item = &[T]> {
    std::iter::from_fn(move || {
        let length = [256, 64, 16, 4, 1].into_iter().find(|length| *length <= rows.len())?;
        let (part, rest) = rows.split_at(length);
        rows = rest;
        Some(part)
    })
}

/// Splits the values of a list into parts of few different lengths, in which values may be
/// repeated: so there are fewer of them than [`parts`].
fn list_parts<T: Copy>(values: &[T]) -> impl Iterator<Item = Vec<T>> {
    values.chunks(256).map(|chunk| {
        let length = [1, 4, 16, 64].into_iter().find(|length| chunk.len() <= *length);
        let mut part = chunk.to_vec();
        part.resize(length.unwrap_or(256), chunk[0]);
        part
    })
}

/// Returns the time, in s since 1970.
pub(crate) fn now() -> i64 {
    now_ms() / 1000
}

/// Returns the time, in ms since 1970.
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
