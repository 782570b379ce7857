//! Items of sqlx, under the names of its facade. The facade itself is not a dependency: it would
//! add its macros and its driver for MySQL to `Cargo.lock`.

use sqlx_core::any::driver::install_drivers;
pub(crate) use sqlx_core::any::{self, Any, AnyConnection, AnyPool};
pub(crate) use sqlx_core::column::ColumnIndex;
pub(crate) use sqlx_core::connection::Connection;
pub(crate) use sqlx_core::encode::{Encode, IsNull};
pub(crate) use sqlx_core::error::{BoxDynError, Error, Result};
pub(crate) use sqlx_core::from_row::FromRow;
pub(crate) use sqlx_core::query::query;
pub(crate) use sqlx_core::query_as::query_as;
pub(crate) use sqlx_core::raw_sql::raw_sql;
pub(crate) use sqlx_core::row::Row;
pub(crate) use sqlx_core::sql_str::AssertSqlSafe;
pub(crate) use sqlx_core::transaction::Transaction;
pub(crate) use sqlx_core::types::Type;

pub(crate) fn install_own_drivers() {
    // An error means that drivers are installed: by an earlier call, as nothing else installs any.
    let _ = install_drivers(&[sqlx_postgres::any::DRIVER, sqlx_sqlite::any::DRIVER]);
}
