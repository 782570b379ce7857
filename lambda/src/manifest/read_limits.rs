//! `[limits]` in `lambda.toml`, where it is what the lambda wants, and in `vehicle.toml`, where it
//! is the most that a lambda gets.

use toml::de::DeTable;

use super::Limits;
use super::error::ManifestError;
use super::syntax;
use super::table::{Document, TomlTable};
use super::value::TomlValue;

type Result<T> = std::result::Result<T, ManifestError>;

/// The table `[limits]`, if there is one; limits that it does not name are those of `missing`.
pub(super) fn limits(value: Option<&TomlValue>, missing: Limits) -> Result<Limits> {
    value
        .map_or(Ok(missing), |value| Limits::read(&value.table("[limits]", Limits::KEYS)?, missing))
}

/// The limits of a vehicle.
pub(super) fn vehicle(document: &Document) -> Result<Limits> {
    let entries =
        DeTable::parse(document.text).map_err(|error| syntax::explain(document, &error))?;
    let root = TomlTable::root(document, entries.get_ref(), &["limits"])?;
    limits(root.get("limits").as_ref(), Limits::MAX)
}
