//! The table `[config]`: its items, and the values that a lambda starts with.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{ItemName, Manifest};
use gleaner_base::text::{excerpt, list, nearest};
use gleaner_base::{Exit, Explain};

/// `[config]`: a setting that a deployment or `--set` may change.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct ConfigItem {
    pub name: ItemName,
    /// Default value. Its type is the type of the key.
    pub default: ConfigValue,
    /// Smallest value, of the default's type; numbers only.
    pub min: Option<ConfigValue>,
    /// Largest value, of the default's type; numbers only.
    pub max: Option<ConfigValue>,
    /// Unit, for the reader.
    pub unit: Option<String>,
    /// Meaning, for the reader.
    pub description: Option<String>,
}

/// A value of `[config]`. Floating-point values are finite. Values of one type have the order of
/// that type; values of different types are never compared.
#[derive(Debug, Clone, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ConfigValue {
    Bool(bool),
    /// A whole number.
    Int(i64),
    Float(f64),
    Text(String),
}

impl ConfigValue {
    /// Parses `text` as a value of the type of `self`; a whole number is also accepted for a
    /// floating-point one.
    fn same_type(&self, text: &str) -> Option<ConfigValue> {
        match self {
            ConfigValue::Bool(_) => text.parse().ok().map(ConfigValue::Bool),
            ConfigValue::Int(_) => text.parse().ok().map(ConfigValue::Int),
            ConfigValue::Float(_) => {
                text.parse().ok().filter(|number: &f64| number.is_finite()).map(ConfigValue::Float)
            }
            ConfigValue::Text(_) => Some(ConfigValue::Text(text.to_owned())),
        }
    }

    fn type_description(&self) -> &'static str {
        match self {
            ConfigValue::Bool(_) => "`true` or `false`",
            ConfigValue::Int(_) => "a whole number, for example 3",
            ConfigValue::Float(_) => "a number, for example 2.5",
            ConfigValue::Text(_) => "a text",
        }
    }
}

impl fmt::Display for ConfigValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ConfigValue::Bool(truth) => truth.fmt(f),
            ConfigValue::Int(number) => number.fmt(f),
            // With a point or exponent, so that 1e300 is short and 50.0 is visibly a float.
            ConfigValue::Float(number) => write!(f, "{number:?}"),
            ConfigValue::Text(text) => text.fmt(f),
        }
    }
}

/// The config values that a lambda starts with.
#[derive(Debug)]
pub enum ConfigSet {}

impl ConfigSet {
    /// Returns every item of `manifest`, in its order, with its default or the last of `overrides`
    /// that names it.
    ///
    /// An override is a name and a text, as in `--set name=text`; the text is parsed as the item's
    /// type, and a whole number is accepted for a floating-point one.
    ///
    /// # Errors
    ///
    /// [`ConfigError`] for the first override that names no item, or whose text is not valid for
    /// that item.
    pub fn resolve(
        manifest: &Manifest,
        overrides: &[(String, String)],
    ) -> Result<Vec<(String, ConfigValue)>, ConfigError> {
        let items = &manifest.config;
        let mut values: Vec<_> =
            items.iter().map(|item| (item.name.to_string(), item.default.clone())).collect();
        for (name, text) in overrides {
            let Some(index) = items.iter().position(|item| item.name == name.as_str()) else {
                let known: Vec<_> = items.iter().map(|item| item.name.to_string()).collect();
                return Err(ConfigError::Unknown {
                    lambda: manifest.lambda.name.to_string(),
                    name: excerpt(name),
                    near: nearest(name, known.iter().map(String::as_str)).map(str::to_owned),
                    known,
                });
            };
            values[index].1 = items[index].accept(text)?;
        }
        Ok(values)
    }
}

impl ConfigItem {
    /// Parses `text` as a value of this item.
    ///
    /// # Errors
    ///
    /// [`ConfigError::WrongType`] or [`ConfigError::OutOfRange`].
    pub fn accept(&self, text: &str) -> Result<ConfigValue, ConfigError> {
        let name = self.name.to_string();
        let Some(value) = self.default.same_type(text) else {
            return Err(ConfigError::WrongType {
                name,
                text: excerpt(text),
                wanted: self.default.type_description(),
            });
        };
        let too_small = self.min.as_ref().is_some_and(|min| value < *min);
        let too_large = self.max.as_ref().is_some_and(|max| value > *max);
        if too_small || too_large {
            return Err(ConfigError::OutOfRange {
                name,
                value,
                min: self.min.clone(),
                max: self.max.clone(),
            });
        }
        Ok(value)
    }
}

/// The reason why a config value cannot be set.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// The lambda has no such item.
    #[error("lambda `{lambda}` has no config value `{name}`")]
    Unknown {
        lambda: String,
        name: String,
        /// An item with a similar name.
        near: Option<String>,
        known: Vec<String>,
    },
    #[error("config value `{name}` cannot be `{text}`")]
    WrongType {
        name: String,
        text: String,
        /// The expected value.
        wanted: &'static str,
    },
    /// The value is outside of the range in the manifest.
    #[error("config value `{name}` cannot be {value}: {}", range(min, max))]
    OutOfRange {
        name: String,
        value: ConfigValue,
        min: Option<ConfigValue>,
        max: Option<ConfigValue>,
    },
}

fn range(min: &Option<ConfigValue>, max: &Option<ConfigValue>) -> String {
    match (min, max) {
        (Some(min), Some(max)) => format!("its range is {min} to {max}"),
        (Some(min), None) => format!("its minimum is {min}"),
        (None, Some(max)) => format!("its maximum is {max}"),
        (None, None) => "it has no range".to_owned(),
    }
}

impl Explain for ConfigError {
    fn help(&self) -> Option<String> {
        Some(match self {
            ConfigError::Unknown { near: Some(near), .. } => format!("did you mean `{near}`?"),
            ConfigError::Unknown { known, .. } if known.is_empty() => {
                "its lambda.toml has no [config]".to_owned()
            }
            ConfigError::Unknown { known, .. } => {
                format!("its config values are {}", list(known, "and"))
            }
            ConfigError::WrongType { wanted, .. } => format!("give {wanted}"),
            ConfigError::OutOfRange { .. } => {
                "the range is set in [config] of its lambda.toml".to_owned()
            }
        })
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest() -> Manifest {
        let text = r#"
            [lambda]
            name = "x"
            version = "0.1.0"
            kind = "python"
            entry = "main.py"
            [schedule]
            period = "1s"
            [config]
            brake_mps2 = { default = -3.0, max = 0.0 }
            dark_luma = { default = 50, min = 0, max = 255 }
            on = true
            label = "dark"
        "#;
        Manifest::parse(text, "lambda.toml").unwrap()
    }

    fn set(name: &str, text: &str) -> Result<Vec<(String, ConfigValue)>, ConfigError> {
        ConfigSet::resolve(&manifest(), &[(name.to_owned(), text.to_owned())])
    }

    #[track_caller]
    fn refused(name: &str, text: &str, message: &str, help: &str) {
        let error = set(name, text).unwrap_err();
        assert_eq!(error.to_string(), message);
        assert_eq!(error.help().as_deref(), Some(help));
        assert_eq!(error.exit(), Exit::Usage);
    }

    #[test]
    fn without_overrides_every_item_has_its_default_in_the_order_of_the_file() {
        let values = ConfigSet::resolve(&manifest(), &[]).unwrap();
        let expected = [
            ("brake_mps2", ConfigValue::Float(-3.0)),
            ("dark_luma", ConfigValue::Int(50)),
            ("on", ConfigValue::Bool(true)),
            ("label", ConfigValue::Text("dark".to_owned())),
        ];
        assert_eq!(values, expected.map(|(name, value)| (name.to_owned(), value)));
    }

    #[test]
    fn an_override_is_parsed_as_the_type_of_its_item_and_the_last_one_wins() {
        assert_eq!(set("brake_mps2", "-4").unwrap()[0].1, ConfigValue::Float(-4.0));
        assert_eq!(set("dark_luma", "255").unwrap()[1].1, ConfigValue::Int(255));
        assert_eq!(set("on", "false").unwrap()[2].1, ConfigValue::Bool(false));
        assert_eq!(set("label", "3").unwrap()[3].1, ConfigValue::Text("3".to_owned()));
        let twice = [("dark_luma", "1"), ("dark_luma", "2")]
            .map(|(name, text)| (name.to_owned(), text.to_owned()));
        assert_eq!(ConfigSet::resolve(&manifest(), &twice).unwrap()[1].1, ConfigValue::Int(2));
    }

    #[test]
    fn an_unknown_item_is_refused_with_the_nearest_name() {
        refused(
            "dark_lume",
            "1",
            "lambda `x` has no config value `dark_lume`",
            "did you mean `dark_luma`?",
        );
        refused(
            "speed",
            "1",
            "lambda `x` has no config value `speed`",
            "its config values are `brake_mps2`, `dark_luma`, `on` and `label`",
        );
    }

    #[test]
    fn a_text_of_another_type_is_refused() {
        refused(
            "dark_luma",
            "1.5",
            "config value `dark_luma` cannot be `1.5`",
            "give a whole number, for example 3",
        );
        refused("on", "yes", "config value `on` cannot be `yes`", "give `true` or `false`");
        for text in ["nan", "inf", "-infinity", "1e999", "", "1,5"] {
            let message = format!("config value `brake_mps2` cannot be `{text}`");
            refused("brake_mps2", text, &message, "give a number, for example 2.5");
        }
    }

    #[test]
    fn a_value_out_of_range_is_refused() {
        let help = "the range is set in [config] of its lambda.toml";
        refused(
            "dark_luma",
            "256",
            "config value `dark_luma` cannot be 256: its range is 0 to 255",
            help,
        );
        refused(
            "brake_mps2",
            "0.5",
            "config value `brake_mps2` cannot be 0.5: its maximum is 0.0",
            help,
        );
    }
}
