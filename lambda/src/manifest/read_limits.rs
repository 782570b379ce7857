//! Parses `[limits]`: of `lambda.toml`, the limits of the lambda; of `vehicle.toml`, the upper
//! bounds for all lambdas.

use toml::de::DeTable;

use super::Limits;
use super::error::ManifestError;
use super::syntax;
use super::table::{Document, TomlTable};
use super::value::TomlValue;

type Result<T> = std::result::Result<T, ManifestError>;

/// Parses the table `[limits]`, if any; limits that it does not name are those of `missing`.
pub(super) fn limits(value: Option<&TomlValue>, missing: Limits) -> Result<Limits> {
    value
        .map_or(Ok(missing), |value| Limits::read(&value.table("[limits]", Limits::KEYS)?, missing))
}

/// Parses the limits of a vehicle.
pub(super) fn vehicle(document: &Document) -> Result<Limits> {
    let entries =
        DeTable::parse(document.text).map_err(|error| syntax::explain(document, &error))?;
    let root = TomlTable::root(document, entries.get_ref(), &["limits"])?;
    limits(root.get("limits").as_ref(), Limits::MAX)
}
