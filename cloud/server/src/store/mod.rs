//! The database: what must survive a restart, apart from files.
//!
//! All SQL is in this room, in the dialect that SQLite and PostgreSQL share. Changes wait for their
//! turn, so that SQLite has one writer in this process. A change of a person is one transaction,
//! with its entry of the audit trail; `writer` commits what vehicles send together.

/// Runs a statement with these values; returns its result.
macro_rules! run {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        sqlx::query($sql)$($(.bind($value))+)?.execute($on).await?
    };
}

/// Runs a query with these values; returns its row, if there is one.
macro_rules! row {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        sqlx::query_as($sql)$($(.bind($value))+)?.fetch_optional($on).await?
    };
}

/// Runs a query with these values; returns its only row.
macro_rules! one {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        sqlx::query_as($sql)$($(.bind($value))+)?.fetch_one($on).await?
    };
}

/// Runs a query with these values; returns its rows.
macro_rules! rows {
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        sqlx::query_as($sql)$($(.bind($value))+)?.fetch_all($on).await?
    };
}

mod audit;
mod deployments;
mod records;
mod secrets;
#[cfg(test)]
mod tests;
mod users;
mod vehicles;
mod writer;

use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure};
use sqlx::any::{AnyConnectOptions, AnyPoolOptions};
use sqlx::{Any, AnyPool, Connection, Transaction};
use tokio::sync::{Mutex, MutexGuard};

use self::writer::WriteQueue;
use crate::error::{CloudError, CloudResult};

pub(crate) use deployments::OfferedDeployment;
pub(crate) use records::{Retention, StreamBatch, name_in_lines};
pub(crate) use users::CONSOLE;
pub(crate) use vehicles::{Issued, VehicleReport};

/// The migrations, oldest first: the version of a database is the number of those that it has.
const MIGRATIONS: &[&str] = &[include_str!("../../migrations/0001_start.sql")];

/// Settings of each connection to SQLite. In the mode WAL, readers and the writer do not wait for
/// each other; FULL makes each commit durable before it returns.
const PRAGMAS: &str = "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; \
                       PRAGMA foreign_keys = ON; PRAGMA busy_timeout = 10000;";

/// Maximum number of queries at a time: with more threads than cores, each only takes longer.
const QUERIES_MAX: u32 = 4;
/// Time that a query waits before the log has it.
const ACQUIRE_SLOW: Duration = Duration::from_secs(20);

/// The database.
pub(crate) struct CloudStore {
    /// Connections of queries.
    pool: AnyPool,
    /// The connection of changes: they do not wait behind the queries of a whole fleet.
    changes: AnyPool,
    turn: Arc<Mutex<()>>,
    writes: WriteQueue,
}

/// A change that is not committed yet; dropped, it is undone.
pub(crate) struct StoreChange<'s> {
    tx: Transaction<'static, Any>,
    _turn: MutexGuard<'s, ()>,
}

impl CloudStore {
    /// Opens the database in this file, and brings it to the newest version.
    ///
    /// # Errors
    ///
    /// A failure if it cannot be opened, or a later version of the program has made it.
    pub(crate) async fn open(path: &Path) -> Result<Self, Failure> {
        let failed = |error: sqlx::Error| {
            let action = format!("cannot open the database `{}`", path.display());
            Failure::caused_by(Exit::Internal, action, &error)
        };
        sqlx::any::install_default_drivers();
        // A path may have the characters that end it in a URL.
        let escaped = path.display().to_string().replace('%', "%25");
        let escaped = escaped.replace('?', "%3f").replace('#', "%23");
        let options = AnyConnectOptions::from_str(&format!("sqlite://{escaped}?mode=rwc"));
        let pool = |connections| {
            AnyPoolOptions::new()
                .max_connections(connections)
                // Each was in order when it was returned.
                .test_before_acquire(false)
                // After a restart, the queries of a whole fleet wait.
                .acquire_slow_threshold(ACQUIRE_SLOW)
                // SQLite itself undoes a transaction, for example on a full disk. Its connection
                // still counts it, and could begin no other one.
                .before_acquire(|connection, _| {
                    let is_usable = !connection.is_in_transaction();
                    Box::pin(async move { Ok(is_usable) })
                })
                .after_connect(|connection, _| {
                    Box::pin(async move {
                        sqlx::raw_sql(PRAGMAS).execute(connection).await?;
                        Ok(())
                    })
                })
        };
        let options = options.map_err(failed)?;
        let changes = pool(1).connect_with(options.clone()).await.map_err(failed)?;
        let pool = pool(QUERIES_MAX).connect_with(options).await.map_err(failed)?;
        let turn = Arc::default();
        let writes = WriteQueue::start(changes.clone(), Arc::clone(&turn));
        let store = Self { pool, changes, turn, writes };
        store.migrate().await?;
        Ok(store)
    }

    async fn migrate(&self) -> CloudResult<()> {
        let mut change = self.change().await?;
        sqlx::raw_sql("CREATE TABLE IF NOT EXISTS migrations (version BIGINT PRIMARY KEY)")
            .execute(&mut *change.tx)
            .await?;
        let (version,): (i64,) =
            one!(&mut *change.tx; "SELECT COALESCE(MAX(version), 0) FROM migrations");
        let newest = MIGRATIONS.len();
        let version = usize::try_from(version).unwrap_or(usize::MAX);
        if version > newest {
            let message = format!("the database has version {version}; this program has {newest}");
            let help = "start the version of gleaner-cloud that made it, or a later one";
            return Err(CloudError::usage(message, help));
        }
        for (index, sql) in MIGRATIONS.iter().enumerate().skip(version) {
            sqlx::raw_sql(*sql).execute(&mut *change.tx).await?;
            let version = int(index as u64 + 1);
            run!(&mut *change.tx; "INSERT INTO migrations (version) VALUES ($1)"; version);
        }
        change.commit().await
    }

    /// Begins a change, once no other one is in progress.
    pub(crate) async fn change(&self) -> CloudResult<StoreChange<'_>> {
        begin(&self.changes, &self.turn).await
    }

    /// Writes a copy of the database to a new file.
    pub(crate) async fn copy_to(&self, file: &str) -> CloudResult<()> {
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
    /// Makes the change durable.
    pub(crate) async fn commit(self) -> CloudResult<()> {
        Ok(self.tx.commit().await?)
    }
}

async fn begin<'s>(pool: &AnyPool, turn: &'s Mutex<()>) -> CloudResult<StoreChange<'s>> {
    let turn = turn.lock().await;
    // A program beside this one, such as `invite`, writes too: a transaction that became a writer
    // only later would fail instead of waiting for it.
    let tx = pool.begin_with("BEGIN IMMEDIATE").await?;
    Ok(StoreChange { tx, _turn: turn })
}

/// Returns the placeholders of `rows` rows: each has `own` values of its own after `shared` ones.
fn placeholders(rows: usize, shared: usize, own: usize) -> String {
    let row = |row| {
        let first = shared + row * own + 1;
        let all: Vec<_> =
            (1..=shared).chain(first..first + own).map(|it| format!("${it}")).collect();
        format!("({})", all.join(", "))
    };
    (0..rows).map(row).collect::<Vec<_>>().join(", ")
}

/// Splits rows into parts of few different lengths: for each, a statement is prepared once.
fn parts<T>(mut rows: &[T]) -> impl Iterator<Item = &[T]> {
    std::iter::from_fn(move || {
        let length = [64, 16, 4, 1].into_iter().find(|length| *length <= rows.len())?;
        let (part, rest) = rows.split_at(length);
        rows = rest;
        Some(part)
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

/// Converts a number for the database, which has no unsigned ones.
fn int(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

/// Converts a number of the database.
fn unsigned(number: i64) -> u64 {
    u64::try_from(number).unwrap_or(0)
}
