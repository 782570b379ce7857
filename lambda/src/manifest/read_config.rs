//! Parses `[config]`, the table whose keys and types the author chooses.

use toml::de::DeValue;

use super::bounds::ITEMS_MAX;
use super::error::ManifestError;
use super::table::TomlTable;
use super::value::TomlValue;
use super::{ConfigItem, ConfigValue};

type Result<T> = std::result::Result<T, ManifestError>;

/// Parses the items of `[config]`, in the order of the file.
pub(super) fn items(value: &TomlValue) -> Result<Vec<ConfigItem>> {
    let entries = value.open_table("[config]")?.entries();
    if entries.len() > ITEMS_MAX {
        let why = format!("has {} keys, above the maximum of {ITEMS_MAX}", entries.len());
        return Err(value.misplaced(why, format!("keep {ITEMS_MAX} or fewer")));
    }
    entries.iter().map(item).collect()
}

fn item(entry: &TomlValue) -> Result<ConfigItem> {
    let name = entry.parse_key()?;
    if !entry.raw().is_table() {
        let default = scalar(
            entry,
            "a number, a text, true or false, or a table such as { default = 1.0, unit = \"m\" }",
        )?;
        return Ok(ConfigItem {
            name,
            default,
            min: None,
            max: None,
            unit: None,
            description: None,
        });
    }
    let title = format!("`{}`", entry.location().key);
    let table = entry.table(&title, &["default", "min", "max", "unit", "description"])?;
    let given = table
        .need("default", "default = 1.0, or another value of the type that the lambda expects")?;
    let default = scalar(&given, "a number, a text, or true or false")?;
    let min = limit(&table, "min", &default)?;
    let max = limit(&table, "max", &default)?;
    if let (Some((_, min)), Some((key, max))) = (&min, &max)
        && max < min
    {
        return Err(key.misplaced(
            format!("is {max}, below `min`, which is {min}"),
            "give a `max` above `min`",
        ));
    }
    let (min, max) = (min.map(|(_, value)| value), max.map(|(_, value)| value));
    given.within(&default, min.as_ref(), max.as_ref(), ConfigValue::to_string)?;
    Ok(ConfigItem {
        name,
        default,
        min,
        max,
        unit: table.optional_text("unit")?,
        description: table.optional_text("description")?,
    })
}

/// Parses the limit `key` of an item, as a value of the type of `default`.
fn limit<'a>(
    table: &TomlTable<'a>,
    key: &str,
    default: &ConfigValue,
) -> Result<Option<(TomlValue<'a>, ConfigValue)>> {
    let Some(value) = table.get(key) else {
        return Ok(None);
    };
    let limit = match (default, scalar(&value, "a number")?) {
        (ConfigValue::Int(_), limit @ ConfigValue::Int(_))
        | (ConfigValue::Float(_), limit @ ConfigValue::Float(_)) => limit,
        (ConfigValue::Float(_), ConfigValue::Int(limit)) => ConfigValue::Float(limit as f64),
        (ConfigValue::Int(_), _) => {
            return Err(value.wrong_type("a whole number, as `default` is one"));
        }
        (ConfigValue::Float(_), _) => return Err(value.wrong_type("a number, as `default` is one")),
        (ConfigValue::Bool(_) | ConfigValue::Text(_), _) => {
            return Err(
                value.misplaced("has no meaning here", "remove it: only numbers have limits")
            );
        }
    };
    Ok(Some((value, limit)))
}

fn scalar(value: &TomlValue, wanted: &str) -> Result<ConfigValue> {
    match value.raw() {
        DeValue::String(text) => Ok(ConfigValue::Text(text.to_string())),
        DeValue::Boolean(truth) => Ok(ConfigValue::Bool(*truth)),
        DeValue::Float(float) => match float.as_str().parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(ConfigValue::Float(number)),
            _ => Err(value.wrong_form(
                float.as_str(),
                "finite number",
                "give a number that is neither infinite nor nan",
            )),
        },
        DeValue::Integer(_) => {
            let number = value.whole_number().unwrap_or(i128::MAX);
            let (min, max) = (i128::from(i64::MIN), i128::from(i64::MAX));
            value.within(&number, Some(&min), Some(&max), i128::to_string)?;
            Ok(ConfigValue::Int(i64::try_from(number).unwrap_or(i64::MAX)))
        }
        DeValue::Datetime(_) | DeValue::Array(_) | DeValue::Table(_) => {
            Err(value.wrong_type(wanted))
        }
    }
}
