//! Values of `[config]` of the lambda, as the deployment sets them.

use crate::world;
use crate::{Error, Result};

/// Value of a `[config]` entry.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub enum ConfigValue {
    Boolean(bool),
    Integer(i64),
    Real(f64),
    Text(String),
}

/// Values of `[config]` by key, in the order of the manifest: those that the deployment sets, or
/// else the defaults.
///
/// ```
/// use gleaner_sdk::{Config, ConfigValue};
///
/// let config = Config::new([("brake_mps2", ConfigValue::Real(-3.0))]);
/// assert_eq!(config.real("brake_mps2").unwrap(), -3.0);
/// assert!(config.text("colour").is_err());
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Config(Vec<(String, ConfigValue)>);

impl Config {
    /// Creates a configuration with these values, for tests.
    pub fn new<'a>(values: impl IntoIterator<Item = (&'a str, ConfigValue)>) -> Self {
        Self(values.into_iter().map(|(key, value)| (key.to_owned(), value)).collect())
    }

    /// Returns the value of `key`; none if the manifest has no such key.
    pub fn get(&self, key: &str) -> Option<&ConfigValue> {
        self.0.iter().find(|(name, _)| name == key).map(|(_, value)| value)
    }

    /// Returns the number at `key`. An integer is converted.
    ///
    /// # Errors
    ///
    /// If there is no such key, or its value is not a number.
    pub fn real(&self, key: &str) -> Result<f64> {
        match self.need(key)? {
            ConfigValue::Real(value) => Ok(*value),
            ConfigValue::Integer(value) => Ok(*value as f64),
            _ => Err(wrong(key, "a number")),
        }
    }

    /// Returns the integer at `key`.
    ///
    /// # Errors
    ///
    /// If there is no such key, or its value is not an integer.
    pub fn integer(&self, key: &str) -> Result<i64> {
        match self.need(key)? {
            ConfigValue::Integer(value) => Ok(*value),
            _ => Err(wrong(key, "an integer")),
        }
    }

    /// Returns the boolean at `key`.
    ///
    /// # Errors
    ///
    /// If there is no such key, or its value is not a boolean.
    pub fn boolean(&self, key: &str) -> Result<bool> {
        match self.need(key)? {
            ConfigValue::Boolean(value) => Ok(*value),
            _ => Err(wrong(key, "true or false")),
        }
    }

    /// Returns the text at `key`.
    ///
    /// # Errors
    ///
    /// If there is no such key, or its value is not a text.
    pub fn text(&self, key: &str) -> Result<&str> {
        match self.need(key)? {
            ConfigValue::Text(value) => Ok(value),
            _ => Err(wrong(key, "a text")),
        }
    }

    fn need(&self, key: &str) -> Result<&ConfigValue> {
        self.get(key).ok_or_else(|| {
            let known = self.0.iter().map(|(name, _)| format!("`{name}`")).collect::<Vec<_>>();
            Error::new(format!("[config] has no `{key}`; its keys: {}", known.join(", ")))
        })
    }
}

fn wrong(key: &str, wanted: &str) -> Error {
    Error::new(format!("`{key}` in [config] is not {wanted}"))
}

impl From<Vec<world::ConfigEntry>> for Config {
    fn from(entries: Vec<world::ConfigEntry>) -> Self {
        use world::ConfigValue as Wit;
        let value = |value| match value {
            Wit::Boolean(value) => ConfigValue::Boolean(value),
            Wit::Integer(value) => ConfigValue::Integer(value),
            Wit::Real(value) => ConfigValue::Real(value),
            Wit::Text(value) => ConfigValue::Text(value),
        };
        Self(entries.into_iter().map(|entry| (entry.key, value(entry.value))).collect())
    }
}
