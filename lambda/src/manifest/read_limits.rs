//! Parses `[limits]`: of `lambda.toml`, the limits of the lambda; of `vehicle.toml`, the upper
//! bounds for all lambdas.

use toml::de::DeTable;

use super::error::ManifestError;
use super::syntax;
use super::table::{Document, TomlTable};
use super::value::TomlValue;
use super::{Limits, bounds};
use crate::vehicle::{InferenceLimits, Vehicle};

type Result<T> = std::result::Result<T, ManifestError>;

/// Parses the table `[limits]`, if any; limits that it does not name are those of `missing`.
pub(super) fn limits(value: Option<&TomlValue>, missing: Limits) -> Result<Limits> {
    value
        .map_or(Ok(missing), |value| Limits::read(&value.table("[limits]", Limits::KEYS)?, missing))
}

/// Parses the configuration of a vehicle.
pub(super) fn vehicle(document: &Document) -> Result<Vehicle> {
    let entries =
        DeTable::parse(document.text).map_err(|error| syntax::explain(document, &error))?;
    let root = TomlTable::root(document, entries.get_ref(), &["limits", "inference"])?;
    let inference = match root.get("inference") {
        None => InferenceLimits::default(),
        Some(value) => {
            let table = value.table("[inference]", &["memory", "run_max", "load_max"])?;
            InferenceLimits {
                memory: table.size("memory", &bounds::INFERENCE_MEMORY)?,
                run_max: table.duration("run_max", &bounds::RUN_MAX)?,
                load_max: table.duration("load_max", &bounds::LOAD_MAX)?,
            }
        }
    };
    Ok(Vehicle { limits: limits(root.get("limits").as_ref(), Limits::MAX)?, inference })
}
