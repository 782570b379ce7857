//! Items of sqlx, under the names of its facade. The facade itself is not a dependency: it would
//! add its macros and its driver for MySQL to `Cargo.lock`.

use std::sync::Once;

use sqlx_core::any::driver::install_drivers;
pub(crate) use sqlx_core::any::{self, Any, AnyConnection, AnyPool};
pub(crate) use sqlx_core::connection::Connection;
pub(crate) use sqlx_core::error::{Error, Result};
pub(crate) use sqlx_core::from_row::FromRow;
pub(crate) use sqlx_core::query::query;
pub(crate) use sqlx_core::query_as::query_as;
pub(crate) use sqlx_core::raw_sql::raw_sql;
pub(crate) use sqlx_core::row::Row;
pub(crate) use sqlx_core::sql_str::AssertSqlSafe;
pub(crate) use sqlx_core::transaction::Transaction;

/// Installs the drivers of SQLite and PostgreSQL at the first call.
pub(crate) fn install_own_drivers() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // It fails only if other drivers were installed before, and this is the only caller.
        let _ = install_drivers(&[sqlx_postgres::any::DRIVER, sqlx_sqlite::any::DRIVER]);
    });
}
