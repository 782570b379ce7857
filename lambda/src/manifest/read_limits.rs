//! Parses `[limits]`: of `lambda.toml`, the limits of the lambda; of `vehicle.toml`, the upper
//! bounds for all lambdas.

use super::Limits;
use super::error::ManifestError;
use super::value::TomlValue;

type Result<T> = std::result::Result<T, ManifestError>;

/// Parses the table `[limits]`, if any; limits that it does not name are those of `missing`.
pub(super) fn limits(value: Option<&TomlValue>, missing: Limits) -> Result<Limits> {
    value
        .map_or(Ok(missing), |value| Limits::read(&value.table("[limits]", Limits::KEYS)?, missing))
}
