//! Walks a TOML document and keeps the location of each value for error messages.
//!
//! A [`TomlTable`] is created with its known keys and refuses all others; a [`TomlValue`] is parsed
//! as the expected type. Neither depends on what a lambda is.

use std::time::Duration;

use toml::de::DeTable;

use super::ByteSize;
use super::bounds::Bounds;
use super::error::ManifestError;
use super::value::TomlValue;
use gleaner_base::text::{excerpt, nearest};

type Result<T> = std::result::Result<T, ManifestError>;

/// The text of a manifest and its name in messages.
pub(super) struct Document<'a> {
    pub(super) text: &'a str,
    pub(super) file: &'a str,
}

impl Document<'_> {
    /// Returns the line, from 1, of the byte at `offset`.
    pub(super) fn line(&self, offset: usize) -> usize {
        self.text.bytes().take(offset).filter(|byte| *byte == b'\n').count() + 1
    }
}

pub(super) struct TomlTable<'a> {
    pub(super) document: &'a Document<'a>,
    /// The path of its keys, for example `schedule`; empty at the top.
    pub(super) path: String,
    /// Header of the table in the file, for example `[schedule]` or `[[input]]`.
    pub(super) title: String,
    pub(super) offset: usize,
    pub(super) entries: &'a DeTable<'a>,
}

impl<'a> TomlTable<'a> {
    /// Returns the top level of the document.
    pub(super) fn root(
        document: &'a Document<'a>,
        entries: &'a DeTable<'a>,
        known: &'static [&'static str],
    ) -> Result<TomlTable<'a>> {
        TomlTable { document, path: String::new(), title: String::new(), offset: 0, entries }
            .check_keys(known)
    }

    pub(super) fn check_keys(self, known: &'static [&'static str]) -> Result<TomlTable<'a>> {
        let Some(value) = self.entries().into_iter().find(|value| !known.contains(&value.name))
        else {
            return Ok(self);
        };
        Err(ManifestError::UnknownKey {
            file: self.document.file.to_owned(),
            line: value.line(),
            key: excerpt(value.name),
            within: if self.path.is_empty() {
                "at the top level".to_owned()
            } else {
                format!("in {}", self.title)
            },
            near: nearest(value.name, known.iter().copied()),
            known,
        })
    }

    /// Returns all values, in the order of the file.
    pub(super) fn entries(&self) -> Vec<TomlValue<'a>> {
        let mut values: Vec<_> =
            self.entries.keys().filter_map(|key| self.get(key.get_ref())).collect();
        values.sort_by_key(|value| value.offset);
        values
    }

    pub(super) fn line(&self) -> usize {
        self.document.line(self.offset)
    }

    pub(super) fn get(&self, key: &str) -> Option<TomlValue<'a>> {
        let (name, value) = self.entries.get_key_value(key)?;
        let separator = if self.path.is_empty() { "" } else { "." };
        Some(TomlValue {
            document: self.document,
            name: name.get_ref(),
            path: format!("{}{separator}{}", self.path, excerpt(name.get_ref())),
            offset: name.span().start,
            value: value.get_ref(),
        })
    }

    /// Returns a required value; the error suggests `example`.
    pub(super) fn need(&self, key: &'static str, example: &'static str) -> Result<TomlValue<'a>> {
        self.get(key).ok_or_else(|| ManifestError::MissingKey {
            file: self.document.file.to_owned(),
            line: self.line(),
            table: self.title.clone(),
            key,
            example,
        })
    }

    /// Returns the tables of `[[key]]`; none if the key is missing.
    pub(super) fn tables(
        &self,
        key: &str,
        known: &'static [&'static str],
    ) -> Result<Vec<TomlTable<'a>>> {
        let Some(value) = self.get(key) else {
            return Ok(Vec::new());
        };
        let title = format!("[[{}]]", value.path);
        let items = value.items(&format!("entries that begin with {title}"))?;
        items.into_iter().map(|item| item.table(&title, known)).collect()
    }

    pub(super) fn optional_text(&self, key: &str) -> Result<Option<String>> {
        self.get(key).map(|value| value.text().map(str::to_owned)).transpose()
    }

    /// Returns a boolean; `false` if the key is missing.
    pub(super) fn flag(&self, key: &str) -> Result<bool> {
        self.get(key).map_or(Ok(false), |value| value.boolean())
    }

    pub(super) fn choice<T: Copy>(
        &self,
        key: &str,
        choices: &[(&'static str, T)],
        default: T,
    ) -> Result<T> {
        self.get(key).map_or(Ok(default), |value| value.choice(choices))
    }

    pub(super) fn integer(&self, key: &str, bounds: &Bounds<u64>) -> Result<u64> {
        self.get(key).map_or(Ok(bounds.default), |value| value.integer(&bounds.range()))
    }

    pub(super) fn size(&self, key: &str, bounds: &Bounds<ByteSize>) -> Result<ByteSize> {
        self.get(key).map_or(Ok(bounds.default), |value| value.size(&bounds.range()))
    }

    pub(super) fn duration(&self, key: &str, bounds: &Bounds<Duration>) -> Result<Duration> {
        self.get(key).map_or(Ok(bounds.default), |value| value.duration(&bounds.range()))
    }
}
