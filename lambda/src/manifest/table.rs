//! Walks a TOML document and remembers where everything stands, so that a refusal can say it.
//!
//! A [`TomlTable`] is made with the keys that it may have and refuses all others; a [`TomlValue`] is read
//! as what it should be. Neither knows what a lambda is.

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
    /// The line, from 1, of the byte at `offset`.
    pub(super) fn line(&self, offset: usize) -> usize {
        self.text.bytes().take(offset).filter(|byte| *byte == b'\n').count() + 1
    }
}

/// A table all of whose keys are known.
pub(super) struct TomlTable<'a> {
    pub(super) document: &'a Document<'a>,
    /// The path of its keys, for example `schedule`; empty at the top.
    pub(super) path: String,
    /// As it is written, for example `[schedule]` or `[[input]]`.
    pub(super) title: String,
    pub(super) offset: usize,
    pub(super) entries: &'a DeTable<'a>,
}

impl<'a> TomlTable<'a> {
    /// The document itself.
    pub(super) fn root(
        document: &'a Document<'a>,
        entries: &'a DeTable<'a>,
        known: &'static [&'static str],
    ) -> Result<TomlTable<'a>> {
        TomlTable { document, path: String::new(), title: String::new(), offset: 0, entries }
            .knowing(known)
    }

    /// The same table, if it has no key but these.
    pub(super) fn knowing(self, known: &'static [&'static str]) -> Result<TomlTable<'a>> {
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

    /// All values, in the order of the file.
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

    /// A value that must be there; `example` is what to write if it is not.
    pub(super) fn need(&self, key: &'static str, example: &'static str) -> Result<TomlValue<'a>> {
        self.get(key).ok_or_else(|| ManifestError::MissingKey {
            file: self.document.file.to_owned(),
            line: self.line(),
            table: self.title.clone(),
            key,
            example,
        })
    }

    /// The tables of `[[key]]`, none if there is no such key.
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

    /// `true` or `false`; `false` if it is not there.
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
