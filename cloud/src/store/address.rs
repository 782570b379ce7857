//! The place of the database: a file of SQLite, or a PostgreSQL server.

use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

use gleaner_base::{Exit, Failure};

use crate::error::database_failure;
use crate::sqlx::any::{AnyConnectOptions, AnyPoolOptions};
use crate::sqlx::{self, AnyConnection, AnyPool, Connection};

/// Settings of each connection to SQLite. In the mode WAL, readers and the writer do not wait for
/// each other; FULL makes each commit durable before it returns. Pages that change often are copied
/// to the database once in 16 MB of changes.
const PRAGMAS: &str = "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; \
                       PRAGMA wal_autocheckpoint = 4000; \
                       PRAGMA foreign_keys = ON; PRAGMA busy_timeout = 10000;";

/// Settings of each connection to PostgreSQL: a process that was stopped in the middle of a change,
/// or whose machine is gone, keeps the others waiting for so long at most.
const SETTINGS: &str = "SET idle_in_transaction_session_timeout = '15s'; \
                        SET lock_timeout = '25s'; SET tcp_keepalives_idle = 10; \
                        SET tcp_keepalives_interval = 5; SET tcp_keepalives_count = 3";

/// Time that a query waits before the log has it.
const ACQUIRE_SLOW: Duration = Duration::from_secs(20);

/// Longest wait for a connection. A server that is down is tried again until then.
const WAIT_SQLITE: Duration = Duration::from_secs(30);
const WAIT_POSTGRES: Duration = Duration::from_secs(4);

/// Beginning of a change in SQLite. A program beside this one, such as `invite`, writes too: a
/// transaction that became a writer only later would fail instead of waiting for it.
const BEGIN_SQLITE: &str = "BEGIN IMMEDIATE";

/// Beginning of a change in PostgreSQL, which waits for others as SQLite does: each change has its
/// place in the audit trail. The number is that of this program.
const BEGIN_POSTGRES: &str = "BEGIN; SELECT pg_advisory_xact_lock(7021465)";

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum StoreAddress {
    /// A file of SQLite, as a URL.
    Sqlite(String),
    /// A database of a PostgreSQL server, as a URL.
    Postgres(String),
}

impl StoreAddress {
    pub(crate) fn file(path: &Path) -> Self {
        // A path may have the characters that end it in a URL.
        let escaped = path.display().to_string().replace('%', "%25");
        let escaped = escaped.replace('?', "%3f").replace('#', "%23");
        Self::Sqlite(format!("sqlite://{escaped}?mode=rwc"))
    }

    /// Parses the URL of a server.
    /// Fails if it is none of PostgreSQL. It does not repeat the URL, which may have a password.
    pub(crate) fn server(url: &str) -> Result<Self, Failure> {
        if url.starts_with("postgres://") || url.starts_with("postgresql://") {
            return Ok(Self::Postgres(url.to_owned()));
        }
        Err(Failure::new(Exit::Usage, "--store is not the address of a PostgreSQL server")
            .with_help("write postgres://USER@HOST/DATABASE, with the password in PGPASSWORD"))
    }

    pub(super) fn begin(&self) -> &'static str {
        match self {
            Self::Sqlite(_) => BEGIN_SQLITE,
            Self::Postgres(_) => BEGIN_POSTGRES,
        }
    }

    /// Makes at most this many connections.
    pub(super) async fn connect(&self, connections: u32) -> Result<AnyPool, Failure> {
        sqlx::install_own_drivers();
        let is_sqlite = matches!(self, Self::Sqlite(_));
        let (Self::Sqlite(url) | Self::Postgres(url)) = self;
        let failed = |error: sqlx::Error| {
            let help = match is_sqlite {
                true if error.as_database_error().is_some() => return database_failure(&error),
                true => "check that --data is a folder of this user on a disk with room",
                false => "check --store, PGPASSWORD, and that the server runs",
            };
            Failure::caused_by(Exit::Internal, "cannot open the database", &error).with_help(help)
        };
        let options = AnyConnectOptions::from_str(url).map_err(failed)?;
        if is_sqlite {
            // A pool would try it again and again for its whole wait, and lose the reason.
            let mut first = AnyConnection::connect_with(&options).await.map_err(failed)?;
            sqlx::raw_sql(PRAGMAS).execute(&mut first).await.map_err(failed)?;
            let look = "SELECT COUNT(*) FROM sqlite_master";
            sqlx::raw_sql(look).execute(&mut first).await.map_err(failed)?;
            first.close().await.map_err(failed)?;
        }
        // SQLite is never away, and its queries may have to wait for those of a whole fleet.
        let wait = if is_sqlite { WAIT_SQLITE } else { WAIT_POSTGRES };
        let pool = AnyPoolOptions::new()
            .acquire_timeout(wait)
            .max_connections(connections)
            // After a restart, the queries of a whole fleet wait.
            .acquire_slow_threshold(ACQUIRE_SLOW)
            // A connection to a file is in order as long as it is open.
            .test_before_acquire(!is_sqlite)
            // SQLite itself undoes a transaction, for example on a full disk. Its connection still
            // counts it, and could begin no other one.
            .before_acquire(|connection, _| {
                let is_usable = !connection.is_in_transaction();
                Box::pin(async move { Ok(is_usable) })
            })
            .after_connect(move |connection, _| {
                Box::pin(async move {
                    let settings = if is_sqlite { PRAGMAS } else { SETTINGS };
                    sqlx::raw_sql(settings).execute(connection).await?;
                    Ok(())
                })
            });
        pool.connect_with(options).await.map_err(failed)
    }
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::*;

    #[tokio::test]
    async fn a_damaged_file_is_named_at_once_with_the_way_out() {
        let folder = TempDir::new().unwrap();
        let path = folder.path().join("cloud.db");
        // The head of a database, and then nothing that is one.
        let mut damaged = b"SQLite format 3\0".to_vec();
        damaged.resize(8192, 0xff);
        for content in [&b"no database at all"[..], &[7; 5000], &damaged] {
            std::fs::write(&path, content).unwrap();
            let failure = StoreAddress::file(&path).connect(1).await.unwrap_err();
            let text = failure.to_string();
            assert!(text.contains("`cloud.db` in the data folder, is damaged"), "{text}");
            assert!(text.contains("gleaner-cloud backup"), "{text}");
            assert_eq!(failure.exit, Exit::Internal);
        }
    }
}
