//! What each key of `[limits]` is: in `lambda.toml`, where it is what the lambda wants, and in `vehicle.toml`, where it is the most
//! that a lambda gets.

use std::time::Duration;

use toml::de::DeTable;

use super::bounds::{self, Bounds};
use super::error::ManifestError;
use super::syntax;
use super::table::{Document, Table};
use super::value::Value;
use super::{ByteSize, Limits};

type Result<T> = std::result::Result<T, ManifestError>;

/// The keys, in their order.
pub(super) const KEYS: &[&str; 15] = &[
    "fuel",
    "init_fuel",
    "deadline",
    "init_deadline",
    "memory",
    "tables",
    "stack",
    "handles",
    "frames",
    "call_bytes",
    "call_items",
    "scratch",
    "log_lines",
    "log_bytes",
    "events_per_minute",
];

/// What a key stands for that is not there.
#[derive(Clone, Copy)]
pub(super) enum Missing {
    /// Its default.
    Default,
    /// Its maximum.
    Most,
    /// Its minimum.
    #[cfg(test)]
    Least,
}

impl Missing {
    fn of<T: Copy>(self, bounds: Bounds<T>) -> Bounds<T> {
        let default = match self {
            Missing::Default => bounds.default,
            Missing::Most => bounds.max,
            #[cfg(test)]
            Missing::Least => bounds.min,
        };
        Bounds { default, ..bounds }
    }
}

/// The table `[limits]`, if there is one.
pub(super) fn limits(value: Option<&Value>, missing: Missing) -> Result<Limits> {
    all(value.map(|value| value.table("[limits]", KEYS)).transpose()?, missing)
}

/// The limits of a vehicle.
pub(super) fn vehicle(document: &Document) -> Result<Limits> {
    let entries = DeTable::parse(document.text).map_err(|error| syntax::explain(document, &error))?;
    let root = Table::root(document, entries.get_ref(), &["limits"])?;
    limits(root.get("limits").as_ref(), Missing::Most)
}

/// All limits. It cannot fail without a table.
pub(super) fn all(table: Option<Table>, missing: Missing) -> Result<Limits> {
    let table = table.as_ref();
    let integer = |key, bounds: Bounds<u64>| {
        let bounds = missing.of(bounds);
        table.map_or(Ok(bounds.default), |table| table.integer(key, &bounds))
    };
    let size = |key, bounds: Bounds<ByteSize>| {
        let bounds = missing.of(bounds);
        table.map_or(Ok(bounds.default), |table| table.size(key, &bounds))
    };
    let duration = |key, bounds: Bounds<Duration>| {
        let bounds = missing.of(bounds);
        table.map_or(Ok(bounds.default), |table| table.duration(key, &bounds))
    };
    Ok(Limits {
        fuel: integer("fuel", bounds::FUEL)?,
        init_fuel: integer("init_fuel", bounds::INIT_FUEL)?,
        deadline: duration("deadline", bounds::DEADLINE)?,
        init_deadline: duration("init_deadline", bounds::INIT_DEADLINE)?,
        memory: size("memory", bounds::MEMORY)?,
        tables: integer("tables", bounds::TABLES)?,
        stack: size("stack", bounds::STACK)?,
        handles: integer("handles", bounds::HANDLES)?,
        frames: integer("frames", bounds::FRAMES)?,
        call_bytes: size("call_bytes", bounds::CALL_BYTES)?,
        call_items: integer("call_items", bounds::CALL_ITEMS)?,
        scratch: size("scratch", bounds::SCRATCH)?,
        log_lines: integer("log_lines", bounds::LOG_LINES)?,
        log_bytes: size("log_bytes", bounds::LOG_BYTES)?,
        events_per_minute: integer("events_per_minute", bounds::EVENTS_PER_MINUTE)?,
    })
}
