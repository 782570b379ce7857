//! What the database needs of sqlx, by the names of its facade. That one would lock its macros and
//! its driver for MySQL with it, which nothing here uses.

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

/// Installs the drivers of both databases, unless they are.
pub(crate) fn install_own_drivers() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // It fails only if others were installed, which nothing here does.
        let _ = install_drivers(&[sqlx_postgres::any::DRIVER, sqlx_sqlite::any::DRIVER]);
    });
}
