//! Parses one table of a `lambda.toml`: refuses unknown keys, and reads each key with its type and
//! bounds.

use gleaner_rules::text::quoted;
use gleaner_rules::units;
use toml::{Table as Entries, Value};

use super::error::{Error, nearest};

type Result<T> = std::result::Result<T, Error>;

/// Minimum, default and maximum.
pub(super) type Bounds = (u64, u64, u64);

const ITEMS_MAX: usize = 256;
const SEE: &str = "see docs/manifest.md for its keys";

/// A table; `title` is its name in the file, such as `[schedule]`.
pub(super) struct Table<'a> {
    title: String,
    pub(super) entries: &'a Entries,
}

impl<'a> Table<'a> {
    pub(super) fn new(title: &str, value: &'a Value, known: &[&str]) -> Result<Self> {
        let entries = value.as_table().ok_or_else(|| refusal(title, "is not a table", SEE))?;
        Self::of(title, entries, known)
    }

    pub(super) fn of(title: &str, entries: &'a Entries, known: &[&str]) -> Result<Self> {
        if let Some(key) = entries.keys().find(|key| !known.contains(&key.as_str())) {
            let near = nearest(key, known.iter().copied());
            let many = || format!("it may have {}", quoted(known.iter().copied()));
            let help = near.map_or_else(many, |near| format!("did you mean `{near}`?"));
            return Err(refusal(title, &format!("has no key `{key}`"), &help));
        }
        Ok(Self { title: title.to_owned(), entries })
    }

    pub(super) fn refusal(&self, cause: &str, help: &str) -> Error {
        refusal(&self.title, cause, help)
    }

    pub(super) fn get(&self, key: &str) -> Option<&'a Value> {
        self.entries.get(key)
    }

    pub(super) fn need(&self, key: &str, example: &str) -> Result<&'a Value> {
        self.get(key)
            .ok_or_else(|| self.refusal(&format!("has no `{key}`"), &format!("add {example}")))
    }

    /// Reads a text that satisfies `is_right`.
    pub(super) fn text(
        &self,
        key: &str,
        example: &str,
        is_right: fn(&str) -> bool,
    ) -> Result<String> {
        let help = format!("write it as in {example}");
        match self.need(key, example)?.as_str() {
            Some(text) if is_right(text) => Ok(text.to_owned()),
            Some(text) => {
                let shown = text.chars().take(64).collect::<String>();
                Err(self.refusal(&format!("has the {key} `{shown}`"), &help))
            }
            None => Err(self.refusal(&format!("has a `{key}` that is not a text"), &help)),
        }
    }

    pub(super) fn choice(&self, key: &str, choices: &[&str]) -> Result<Option<&'a str>> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let chosen = value.as_str().filter(|text| choices.contains(text));
        let help = || format!("choose {}", quoted(choices.iter().copied()));
        chosen
            .map(Some)
            .ok_or_else(|| self.refusal(&format!("has the {key} {}", shown(value)), &help()))
    }

    pub(super) fn integer(&self, key: &str, bounds: Bounds) -> Result<u64> {
        let Some(value) = self.get(key) else { return Ok(bounds.1) };
        let help = || format!("for example {key} = {}", bounds.1);
        let whole = value.as_integer();
        let whole = whole.ok_or_else(|| {
            self.refusal(&format!("has a `{key}` that is not a whole number"), &help())
        })?;
        self.within(key, u64::try_from(whole).ok(), value, bounds)
    }

    /// Reads a size in bytes.
    pub(super) fn size(&self, key: &str, bounds: Bounds) -> Result<u64> {
        match self.get(key) {
            None => Ok(bounds.1),
            Some(Value::Integer(_)) => self.integer(key, bounds),
            Some(value) => {
                let bytes = value.as_str().and_then(units::size);
                let bytes = bytes.ok_or_else(|| {
                    self.refusal(&format!("has the {key} {}", shown(value)), units::SIZE_RULE)
                })?;
                self.within(key, Some(bytes), value, bounds)
            }
        }
    }

    /// Reads a duration in nanoseconds.
    pub(super) fn duration(&self, key: &str, bounds: Bounds) -> Result<u64> {
        let Some(value) = self.get(key) else { return Ok(bounds.1) };
        let ns = value.as_str().and_then(units::duration);
        let ns = ns.ok_or_else(|| {
            self.refusal(&format!("has the {key} {}", shown(value)), units::TIME_RULE)
        })?;
        self.within(key, Some(ns), value, bounds)
    }

    fn within(
        &self,
        key: &str,
        given: Option<u64>,
        value: &Value,
        (min, _, max): Bounds,
    ) -> Result<u64> {
        given.filter(|given| (min..=max).contains(given)).ok_or_else(|| {
            self.refusal(
                &format!("has a `{key}` of {}", shown(value)),
                &format!("its range is {min} to {max}"),
            )
        })
    }

    pub(super) fn list(&self, key: &str) -> Result<&'a [Value]> {
        let Some(value) = self.get(key) else { return Ok(&[]) };
        let list = value.as_array().filter(|list| list.len() <= ITEMS_MAX);
        let why = || format!("has a `{key}` that is not a list of at most {ITEMS_MAX} items");
        list.map(Vec::as_slice).ok_or_else(|| self.refusal(&why(), SEE))
    }
}

/// Formats a value for an error message.
fn shown(value: &Value) -> String {
    match value {
        Value::String(text) => format!("\"{}\"", text.chars().take(64).collect::<String>()),
        Value::Integer(number) => number.to_string(),
        Value::Float(number) => number.to_string(),
        Value::Boolean(value) => value.to_string(),
        Value::Datetime(_) | Value::Array(_) | Value::Table(_) => {
            format!("of type {}", value.type_str())
        }
    }
}

fn refusal(title: &str, cause: &str, help: &str) -> Error {
    Error::new("cannot use the manifest", format!("{title} {cause}"), help)
}
