//! Parses one value of a TOML document as the expected type; errors name its location.

use std::ops::RangeInclusive;
use std::str::FromStr;
use std::time::Duration;

use toml::Spanned;
use toml::de::DeValue;

use super::bounds::ITEMS_MAX;
use super::error::{KeyLocation, ManifestError};
use super::table::{Document, TomlTable};
use super::{ByteSize, NameError, UnitError, format_duration, parse_duration};
use gleaner_base::text::{excerpt, nearest};

type Result<T> = std::result::Result<T, ManifestError>;

/// A value and the key it belongs to.
#[derive(Clone)]
pub(super) struct TomlValue<'a> {
    pub(super) document: &'a Document<'a>,
    /// Key of the value, the last part of `path`, as it is in the file.
    pub(super) name: &'a str,
    pub(super) path: String,
    pub(super) offset: usize,
    pub(super) value: &'a DeValue<'a>,
}

impl<'a> TomlValue<'a> {
    pub(super) fn line(&self) -> usize {
        self.document.line(self.offset)
    }

    pub(super) fn location(&self) -> Box<KeyLocation> {
        Box::new(KeyLocation {
            file: self.document.file.to_owned(),
            line: self.line(),
            key: self.path.clone(),
        })
    }

    pub(super) fn raw(&self) -> &'a DeValue<'a> {
        self.value
    }

    /// Returns the error for a value of another type; `wanted` describes the expected value.
    pub(super) fn wrong_type(&self, wanted: &str) -> ManifestError {
        let found = match self.value {
            DeValue::String(_) => "a text",
            DeValue::Integer(_) => "a whole number",
            DeValue::Float(_) => "a number with a fraction",
            DeValue::Boolean(_) => "true or false",
            DeValue::Datetime(_) => "a date or time",
            DeValue::Array(_) => "an array",
            DeValue::Table(_) => "a table",
        };
        ManifestError::WrongType { at: self.location(), found, wanted: wanted.to_owned() }
    }

    /// Returns the error for a text that should be a `what`; `rule` describes its form.
    pub(super) fn wrong_form(
        &self,
        text: &str,
        what: &'static str,
        rule: &'static str,
    ) -> ManifestError {
        ManifestError::WrongForm { at: self.location(), text: excerpt(text), what, rule }
    }

    /// Returns the error for a value that conflicts with other keys.
    pub(super) fn misplaced(
        &self,
        why: impl Into<String>,
        help: impl Into<String>,
    ) -> ManifestError {
        ManifestError::Misplaced { at: self.location(), why: why.into(), help: help.into() }
    }

    /// Returns the value as a table with the keys `known`. `title` is its header in the file.
    pub(super) fn table(
        &self,
        title: &str,
        known: &'static [&'static str],
    ) -> Result<TomlTable<'a>> {
        self.open_table(title)?.check_keys(known)
    }

    /// Returns the value as a table whose keys the author chooses.
    pub(super) fn open_table(&self, title: &str) -> Result<TomlTable<'a>> {
        let DeValue::Table(entries) = self.value else {
            return Err(self.wrong_type("a table"));
        };
        let title = title.to_owned();
        Ok(TomlTable {
            document: self.document,
            path: self.path.clone(),
            title,
            offset: self.offset,
            entries,
        })
    }

    /// Returns the elements of an array, each with its own line.
    pub(super) fn items(&self, wanted: &str) -> Result<Vec<TomlValue<'a>>> {
        let DeValue::Array(items) = self.value else {
            return Err(self.wrong_type(wanted));
        };
        if items.len() > ITEMS_MAX {
            let why = format!("has {} entries, above the maximum of {ITEMS_MAX}", items.len());
            return Err(self.misplaced(why, format!("keep {ITEMS_MAX} or fewer")));
        }
        let item = |item: &'a Spanned<DeValue<'a>>| TomlValue {
            offset: item.span().start,
            value: item.get_ref(),
            ..self.clone()
        };
        Ok(items.iter().map(item).collect())
    }

    pub(super) fn text(&self) -> Result<&'a str> {
        self.value.as_str().ok_or_else(|| self.wrong_type("a text in quotes"))
    }

    pub(super) fn boolean(&self) -> Result<bool> {
        match self.value {
            DeValue::Boolean(truth) => Ok(*truth),
            _ => Err(self.wrong_type("true or false")),
        }
    }

    pub(super) fn parse<T: FromStr<Err = NameError>>(&self) -> Result<T> {
        let text = self.text()?;
        text.parse().map_err(|NameError { what, rule, .. }| self.wrong_form(text, what, rule))
    }

    /// Parses the key itself, where the author chose it.
    pub(super) fn parse_key<T: FromStr<Err = NameError>>(&self) -> Result<T> {
        self.name
            .parse()
            .map_err(|NameError { what, rule, .. }| self.wrong_form(self.name, what, rule))
    }

    /// Parses one of a few words.
    pub(super) fn choice<T: Copy>(&self, choices: &[(&'static str, T)]) -> Result<T> {
        let text = self.text()?;
        if let Some((_, choice)) = choices.iter().find(|(word, _)| *word == text) {
            return Ok(*choice);
        }
        let words: Vec<_> = choices.iter().map(|(word, _)| *word).collect();
        let near = nearest(text, words.iter().copied());
        Err(ManifestError::NoChoice {
            at: self.location(),
            text: excerpt(text),
            choices: words,
            near,
        })
    }

    pub(super) fn integer(&self, range: &RangeInclusive<u64>) -> Result<u64> {
        let Some(number) = self.whole_number() else {
            return Err(self.wrong_type("a whole number"));
        };
        let (min, max) = (i128::from(*range.start()), i128::from(*range.end()));
        self.within(&number, Some(&min), Some(&max), i128::to_string)?;
        // It is within a range of 64 bits, so that the default is never used.
        Ok(u64::try_from(number).unwrap_or(*range.end()))
    }

    /// Parses a number with or without a fraction.
    pub(super) fn number(&self, range: &RangeInclusive<f64>) -> Result<f64> {
        let text = match self.value {
            DeValue::Float(float) => float.as_str(),
            DeValue::Integer(_) => &self.whole_number().unwrap_or(i128::MAX).to_string(),
            _ => return Err(self.wrong_type("a number")),
        };
        let number = text.parse::<f64>().ok().filter(|number| number.is_finite());
        let rule = "give a number that is neither infinite nor nan";
        let number = number.ok_or_else(|| self.wrong_form(text, "finite number", rule))?;
        self.within(&number, Some(range.start()), Some(range.end()), f64::to_string)?;
        Ok(number)
    }

    pub(super) fn size(&self, range: &RangeInclusive<ByteSize>) -> Result<ByteSize> {
        if let Some(text) = self.value.as_str() {
            let size = text
                .parse()
                .map_err(|UnitError { what, rule, .. }| self.wrong_form(text, what, rule))?;
            self.within(&size, Some(range.start()), Some(range.end()), ByteSize::to_string)?;
            return Ok(size);
        }
        let Some(number) = self.whole_number() else {
            return Err(self.wrong_type(
                "a size in quotes, for example \"2 MiB\", or a whole number of bytes",
            ));
        };
        // As 128-bit numbers, since the given one may be negative or beyond 64 bits.
        let (min, max) = (i128::from(range.start().bytes()), i128::from(range.end().bytes()));
        let show = |number: &i128| {
            u64::try_from(*number).map_or(number.to_string(), |n| ByteSize::new(n).to_string())
        };
        self.within(&number, Some(&min), Some(&max), show)?;
        Ok(u64::try_from(number).map_or(*range.end(), ByteSize::new))
    }

    pub(super) fn duration(&self, range: &RangeInclusive<Duration>) -> Result<Duration> {
        let Some(text) = self.value.as_str() else {
            return Err(self.wrong_type("a duration in quotes, for example \"50ms\""));
        };
        let duration = parse_duration(text)
            .map_err(|UnitError { what, rule, .. }| self.wrong_form(text, what, rule))?;
        let show = |duration: &Duration| format_duration(*duration);
        self.within(&duration, Some(range.start()), Some(range.end()), show)?;
        Ok(duration)
    }

    /// Refuses `value` if it is below `min` or above `max`.
    pub(super) fn within<T: PartialOrd>(
        &self,
        value: &T,
        min: Option<&T>,
        max: Option<&T>,
        show: impl Fn(&T) -> String,
    ) -> Result<()> {
        match (min, max) {
            (Some(min), _) if value < min => Err(ManifestError::TooSmall {
                at: self.location(),
                value: show(value),
                min: show(min),
                max: max.map(show),
            }),
            (_, Some(max)) if value > max => Err(ManifestError::TooLarge {
                at: self.location(),
                value: show(value),
                min: min.map(&show),
                max: show(max),
            }),
            _ => Ok(()),
        }
    }

    /// Returns the value as a whole number; one beyond 128 bits is replaced by the largest.
    pub(super) fn whole_number(&self) -> Option<i128> {
        let number = self.value.as_integer()?;
        let huge = if number.as_str().starts_with('-') { i128::MIN } else { i128::MAX };
        Some(i128::from_str_radix(number.as_str(), number.radix()).unwrap_or(huge))
    }
}
