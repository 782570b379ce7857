//! The database: what must survive a restart, apart from files.
//!
//! All SQL is in this room, in the dialect that SQLite and PostgreSQL share. Changes wait for their
//! turn, so that SQLite has one writer in this process; each is one transaction, with its entry of
//! the audit trail.

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
mod clip_list;
mod clips;
mod deployments;
mod records;
mod secrets;
#[cfg(test)]
mod tests;
mod users;
mod vehicles;

use std::path::Path;
use std::str::FromStr;
use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure};
use sqlx::any::{AnyConnectOptions, AnyPoolOptions};
use sqlx::{Any, AnyPool, Transaction};
use tokio::sync::{Mutex, MutexGuard};

use crate::error::{CloudError, CloudResult};

pub(crate) use clip_list::ClipQuery;
pub(crate) use clips::{ClipBounds, ClipProgress};
pub(crate) use deployments::OfferedDeployment;
pub(crate) use records::{Retention, StreamBatch, name_in_lines};
pub(crate) use users::CONSOLE;
pub(crate) use vehicles::{Issued, VehicleReport};

/// The migrations, oldest first: the version of a database is the number of those that it has.
const MIGRATIONS: &[&str] = &[
    include_str!("../../migrations/0001_start.sql"),
    include_str!("../../migrations/0003_clips.sql"),
];

/// Settings of each connection to SQLite. In the mode WAL, readers and the writer do not wait for
/// each other; FULL makes each commit durable before it returns.
const PRAGMAS: &str = "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; \
                       PRAGMA foreign_keys = ON; PRAGMA busy_timeout = 10000;";

/// The database.
#[derive(Debug)]
pub(crate) struct CloudStore {
    pool: AnyPool,
    turn: Mutex<()>,
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
        let pool = AnyPoolOptions::new().max_connections(8).after_connect(|connection, _| {
            Box::pin(async move {
                sqlx::raw_sql(PRAGMAS).execute(connection).await?;
                Ok(())
            })
        });
        let pool = pool.connect_with(options.map_err(failed)?).await.map_err(failed)?;
        let store = Self { pool, turn: Mutex::new(()) };
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
        let turn = self.turn.lock().await;
        // A program beside this one, such as `invite`, writes too: a transaction that became a
        // writer only later would fail instead of waiting for it.
        let tx = self.pool.begin_with("BEGIN IMMEDIATE").await?;
        Ok(StoreChange { tx, _turn: turn })
    }

    /// Writes a copy of the database to a new file.
    pub(crate) async fn copy_to(&self, file: &str) -> CloudResult<()> {
        run!(&self.pool; "VACUUM INTO $1"; file);
        Ok(())
    }

    /// Closes the database, once open changes have ended.
    pub(crate) async fn close(&self) {
        self.pool.close().await;
    }
}

impl StoreChange<'_> {
    /// Makes the change durable.
    pub(crate) async fn commit(self) -> CloudResult<()> {
        Ok(self.tx.commit().await?)
    }
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
