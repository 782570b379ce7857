//! Statements with their values, and rows with their types, for SQLite and PostgreSQL alike.
//!
//! The derive of `FromRow` comes with the facade of sqlx, which is no dependency, and its
//! `QueryBuilder` writes `?` for a value of `Any`, which PostgreSQL does not take: so `query_as`
//! gets its rows, and statements their lists, by the few lines here.

use std::borrow::Cow;
use std::collections::BTreeMap;

use gleaner_fleet::WantedProblem;
use gleaner_fleet::people::VehicleState;
use gleaner_protocol::vehicle_api::GrantStatus;

use super::{CloudStore, StoreChange, int, unsigned};
use crate::error::CloudResult;
use crate::sqlx::any::{AnyArgumentBuffer, AnyRow, AnyTypeInfo};
use crate::sqlx::{
    self, Any, AnyConnection, AnyPool, AssertSqlSafe, BoxDynError, ColumnIndex, Encode, FromRow,
    IsNull, Row, Type,
};

/// Runs a statement with these values; returns its result. As the others, it runs on a change, a
/// store, or the executor that it gets.
macro_rules! run {
    ($on:ident; $($query:tt)+) => { run!($on.on(); $($query)+) };
    ($on:expr; $sql:expr $(; $($value:expr),+)?) => {
        crate::sqlx::query($sql)$($(.bind(crate::store::sql::SqlValue::from($value)))+)?
            .execute($on).await?
    };
}

/// Makes a query with these values, for rows of any [`Typed`].
macro_rules! typed_query {
    ($sql:expr $(; $($value:expr),+)?) => {
        crate::sqlx::query_as::<_, crate::store::sql::TypedRow<_>>($sql)
            $($(.bind(crate::store::sql::SqlValue::from($value)))+)?
    };
}

/// Returns the row of a query, if there is one.
macro_rules! row {
    ($on:ident; $($query:tt)+) => { row!($on.on(); $($query)+) };
    ($on:expr; $($query:tt)+) => {
        typed_query!($($query)+).fetch_optional($on).await?.map(|row| row.0)
    };
}

macro_rules! one {
    ($on:ident; $($query:tt)+) => { one!($on.on(); $($query)+) };
    ($on:expr; $($query:tt)+) => { typed_query!($($query)+).fetch_one($on).await?.0 };
}

macro_rules! rows {
    ($on:ident; $($query:tt)+) => { rows!($on.on(); $($query)+) };
    ($on:expr; $($query:tt)+) => {
        crate::store::sql::read(typed_query!($($query)+).fetch_all($on).await?)
    };
}

/// Returns the rows of a query with `IN ($N..)` for a list, 256 of its values at a time, and these
/// values before them. An order or a group is one of each part, and a value that comes twice may
/// bring its rows twice.
macro_rules! rows_in {
    ($on:ident; $($query:tt)+) => { rows_in!($on.on(); $($query)+) };
    ($on:expr; $sql:expr; $list:expr $(; $($value:expr),+)?) => {{
        let mut rows = Vec::new();
        for part in crate::store::sql::list_parts($list) {
            let sql = crate::store::sql::in_list($sql, part.len());
            let query = typed_query!(sql $(; $($value),+)?);
            let query = part.iter().fold(query, |query, value| query.bind::<&str>(value.as_ref()));
            rows.extend(crate::store::sql::read(query.fetch_all($on).await?));
        }
        rows
    }};
}

macro_rules! values {
    ($($value:expr),+) => { [$(crate::store::sql::SqlValue::from($value)),+] };
}

/// Reads a type whose fields are columns, or types of several columns.
macro_rules! columns {
    ($name:ty: $($field:ident),+) => {
        impl crate::store::sql::Typed for $name {
            fn of(
                row: &crate::sqlx::any::AnyRow,
                _: impl crate::sqlx::ColumnIndex<crate::sqlx::any::AnyRow>,
            ) -> crate::sqlx::Result<Self> {
                Ok(Self { $($field: crate::store::sql::Typed::of(row, stringify!($field))?,)+ })
            }
        }
    };
}

/// Makes a type whose fields are columns, or types of several columns.
macro_rules! typed {
    ($(#[$meta:meta])* $vis:vis struct $name:ident {
        $($(#[$of:meta])* $seen:vis $field:ident: $type:ty,)+
    }) => {
        $(#[$meta])* $vis struct $name { $($(#[$of])* $seen $field: $type,)+ }
        columns!($name: $($field),+);
    };
}

/// Labels, or a selector, as a column has them: JSON.
pub(super) type TextMap = BTreeMap<String, String>;

pub(super) fn map(json: &str) -> TextMap {
    serde_json::from_str(json).unwrap_or_default()
}

pub(super) fn json(value: &impl serde::Serialize) -> String {
    serde_json::to_string(value).unwrap_or_default()
}

/// A value to bind. The database has no unsigned numbers, and no truth values.
pub(super) enum SqlValue<'v> {
    Text(Cow<'v, str>),
    Number(i64),
}

macro_rules! value_from {
    ($($type:ty, |$value:ident| $made:expr;)+) => {$(
        impl<'v> From<$type> for SqlValue<'v> {
            fn from($value: $type) -> Self {
                $made
            }
        }
    )+};
}

value_from! {
    &'v str, |text| Self::Text(text.into());
    &'v String, |text| Self::Text(text.into());
    String, |text| Self::Text(text.into());
    i64, |number| Self::Number(number);
    &'v i64, |number| Self::Number(*number);
    u64, |number| Self::Number(int(number));
    &'v u64, |number| Self::Number(int(*number));
    usize, |number| Self::Number(int(number as u64));
    bool, |is_true| Self::Number(is_true.into());
}

impl Type<Any> for SqlValue<'_> {
    fn type_info() -> AnyTypeInfo {
        // That of each value is the one that it is encoded as.
        <str as Type<Any>>::type_info()
    }
}

impl Encode<'_, Any> for SqlValue<'_> {
    fn encode_by_ref(&self, buffer: &mut AnyArgumentBuffer) -> Result<IsNull, BoxDynError> {
        match self {
            Self::Text(text) => Encode::<Any>::encode(&**text, buffer),
            Self::Number(number) => Encode::<Any>::encode(number, buffer),
        }
    }
}

/// The value of a column, or of several columns of a row.
pub(super) trait Typed: Sized {
    fn of(row: &AnyRow, column: impl ColumnIndex<AnyRow>) -> sqlx::Result<Self>;
}

/// A [`Typed`] as `query_as` reads it.
pub(super) struct TypedRow<T>(pub(super) T);

impl<T: Typed> FromRow<'_, AnyRow> for TypedRow<T> {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        T::of(row, 0).map(Self)
    }
}

pub(super) fn read<T>(rows: Vec<TypedRow<T>>) -> Vec<T> {
    rows.into_iter().map(|row| row.0).collect()
}

macro_rules! typed_values {
    ($($type:ty: $stored:ty, |$value:ident| $made:expr;)+) => {$(
        impl Typed for $type {
            fn of(row: &AnyRow, column: impl ColumnIndex<AnyRow>) -> sqlx::Result<Self> {
                row.try_get::<$stored, _>(column).map(|$value| $made)
            }
        }
    )+};
}

typed_values! {
    String: String, |text| text;
    i64: i64, |number| number;
    Option<i64>: Option<i64>, |number| number;
    Option<u64>: Option<i64>, |number| number.map(unsigned);
    Option<String>: Option<String>, |text| text;
    u64: i64, |number| unsigned(number);
    bool: i64, |number| number != 0;
    TextMap: String, |json| map(&json);
    GrantStatus: String, |json| serde_json::from_str(&json).unwrap_or_default();
    Vec<WantedProblem>: String, |json| serde_json::from_str(&json).unwrap_or_default();
    VehicleState: String, |state| {
        serde_json::from_value(state.into()).unwrap_or(VehicleState::Offline)
    };
}

macro_rules! typed_tuple {
    ($($type:ident $index:literal),+) => {
        impl<$($type: Typed),+> Typed for ($($type,)+) {
            fn of(row: &AnyRow, _: impl ColumnIndex<AnyRow>) -> sqlx::Result<Self> {
                Ok(($($type::of(row, $index)?,)+))
            }
        }
    };
}

typed_tuple!(A 0, B 1);
typed_tuple!(A 0, B 1, C 2);
typed_tuple!(A 0, B 1, C 2, D 3);

impl CloudStore {
    pub(super) fn on(&self) -> &AnyPool {
        &self.pool
    }
}

impl StoreChange<'_> {
    pub(super) fn on(&mut self) -> &mut AnyConnection {
        &mut self.tx
    }

    /// Runs a statement with `IN ($N..)` for the values of a list, and these before them.
    pub(super) async fn run_in<V: AsRef<str>>(
        &mut self,
        sql: &str,
        list: &[V],
        before: &[SqlValue<'_>],
    ) -> CloudResult<()> {
        for part in list_parts(list) {
            let query = sqlx::query(in_list(sql, part.len()));
            let query = before.iter().fold(query, |query, value| query.bind(value));
            let query = part.iter().fold(query, |query, value| query.bind(value.as_ref()));
            query.execute(self.on()).await?;
        }
        Ok(())
    }

    /// Inserts rows, or changes the `others` of their columns where the key exists.
    pub(super) async fn upsert<const N: usize>(
        &mut self,
        (table, key, others): (&str, &str, &str),
        rows: &[[SqlValue<'_>; N]],
    ) -> CloudResult<()> {
        let set: Vec<_> = others.split(", ").map(|it| format!("{it} = excluded.{it}")).collect();
        let sql = format!(
            "INSERT INTO {table} ({key}, {others}) VALUES () ON CONFLICT ({key}) DO UPDATE SET {}",
            set.join(", ")
        );
        self.insert::<i64, N>(&sql, rows).await.map(drop)
    }

    /// Runs a statement with `VALUES ()` for these rows, some at a time; returns what it returns.
    pub(super) async fn insert<T: Typed + Send + Unpin, const N: usize>(
        &mut self,
        sql: &str,
        mut rows: &[[SqlValue<'_>; N]],
    ) -> CloudResult<Vec<T>> {
        let mut returned = Vec::new();
        // Parts of few different lengths: for each, a statement is prepared once.
        let lengths = [256, 64, 16, 4, 1];
        while let Some(length) = lengths.into_iter().find(|length| *length <= rows.len()) {
            let (part, rest) = rows.split_at(length);
            returned.extend(self.with_values(sql, &part.iter().collect::<Vec<_>>()).await?);
            rows = rest;
        }
        Ok(returned)
    }

    /// Runs a statement with `VALUES ()` for these rows, its only values; returns what it returns.
    pub(super) async fn with_values<T: Typed + Send + Unpin, const N: usize>(
        &mut self,
        sql: &str,
        rows: &[&[SqlValue<'_>; N]],
    ) -> CloudResult<Vec<T>> {
        // SQLite gets them without numbers: it searches a list of all numbers for each value.
        let is_sqlite = self.tx.backend_name() == "SQLite";
        let row = |row| match is_sqlite {
            true => format!("({})", ["?"; N].join(", ")),
            false => format!("({})", placeholders(row * N + 1, N)),
        };
        let all = (0..rows.len()).map(row).collect::<Vec<_>>().join(", ");
        let sql = sql.replacen("VALUES ()", &format!("VALUES {all}"), 1);
        let query = sqlx::query_as(AssertSqlSafe(sql));
        let query = rows.iter().copied().flatten().fold(query, |query, value| query.bind(value));
        Ok(read(query.fetch_all(self.on()).await?))
    }
}

/// Replaces `$N..` by the placeholders of `count` values from that number on.
pub(super) fn in_list(sql: &str, count: usize) -> AssertSqlSafe<String> {
    let (before, after) = sql.split_once("..").unwrap_or((sql, ""));
    let (before, first) = before.rsplit_once('$').unwrap_or((before, ""));
    let list = placeholders(first.parse().unwrap_or(1), count);
    AssertSqlSafe(format!("{before}{list}{after}"))
}

fn placeholders(first: usize, count: usize) -> String {
    let all: Vec<_> = (first..first + count).map(|number| format!("${number}")).collect();
    all.join(", ")
}

/// Splits the values of a list into parts of few different lengths, in which values may be
/// repeated: so there are fewer of them than of rows that are inserted.
pub(super) fn list_parts<T>(values: &[T]) -> impl Iterator<Item = Vec<&T>> {
    values.chunks(256).map(|chunk| {
        let length = [1, 4, 16, 64].into_iter().find(|length| chunk.len() <= *length);
        let mut part: Vec<_> = chunk.iter().collect();
        part.resize(length.unwrap_or(256), &chunk[0]);
        part
    })
}
