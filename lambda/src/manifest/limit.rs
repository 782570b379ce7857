//! Parses and formats one limit of the table in `limits.rs`, by its unit.

use std::time::Duration;

use super::bounds::Bounds;
use super::table::TomlTable;
use super::{ByteSize, ManifestError, format_duration};
use gleaner_base::grouped;

/// A type of limit.
pub(super) trait Unit: Copy + Ord {
    /// The name of the unit in `docs/manifest.md`.
    const NAME: &'static str;

    /// Parses the value of `key`; the default if the table does not have the key.
    fn read(table: &TomlTable, key: &str, bounds: &Bounds<Self>) -> Result<Self, ManifestError>;

    /// Returns the value as it is written in the file, without quotes.
    fn describe(self) -> String;

    /// Returns the value as in JSON and the SDKs: a number, bytes, or nanoseconds.
    fn plain(self) -> u64;

    /// Converts a number of [`plain`](Self::plain) back.
    fn of_plain(plain: u64) -> Self;
}

impl Unit for u64 {
    const NAME: &'static str = "number";

    fn read(table: &TomlTable, key: &str, bounds: &Bounds<u64>) -> Result<u64, ManifestError> {
        table.integer(key, bounds)
    }

    fn describe(self) -> String {
        self.to_string()
    }

    fn plain(self) -> u64 {
        self
    }

    fn of_plain(plain: u64) -> u64 {
        plain
    }
}

impl Unit for ByteSize {
    const NAME: &'static str = "size";

    fn read(
        table: &TomlTable,
        key: &str,
        bounds: &Bounds<ByteSize>,
    ) -> Result<ByteSize, ManifestError> {
        table.size(key, bounds)
    }

    fn describe(self) -> String {
        self.to_string()
    }

    fn plain(self) -> u64 {
        self.bytes()
    }

    fn of_plain(plain: u64) -> ByteSize {
        ByteSize::new(plain)
    }
}

impl Unit for Duration {
    const NAME: &'static str = "duration";

    fn read(
        table: &TomlTable,
        key: &str,
        bounds: &Bounds<Duration>,
    ) -> Result<Duration, ManifestError> {
        table.duration(key, bounds)
    }

    fn describe(self) -> String {
        format_duration(self)
    }

    fn plain(self) -> u64 {
        // None of them exceeds an hour, so that their nanoseconds fit.
        u64::try_from(self.as_nanos()).unwrap_or(u64::MAX)
    }

    fn of_plain(plain: u64) -> Duration {
        Duration::from_nanos(plain)
    }
}

/// A limit, for docs and for generated code.
pub(super) struct Limit {
    pub(super) key: &'static str,
    pub(super) unit: &'static str,
    /// Doc comment of the limit, which begins with a space.
    pub(super) meaning: &'static str,
    /// Minimum, default and maximum, plain.
    pub(super) plain: [u64; 3],
    /// The same, as written in the file; large numbers have commas.
    pub(super) words: [String; 3],
}

impl Limit {
    pub(super) fn new<T: Unit>(
        key: &'static str,
        meaning: &'static str,
        bounds: Bounds<T>,
    ) -> Limit {
        let Bounds { min, default, max } = bounds;
        let word = |value: T| match T::NAME {
            "number" => grouped(value.plain()),
            _ => value.describe(),
        };
        let values = [min, default, max];
        Limit { key, unit: T::NAME, meaning, plain: values.map(T::plain), words: values.map(word) }
    }

    /// Returns minimum, default and maximum, as typed in the file.
    pub(super) fn typed(&self) -> [String; 3] {
        let quoted = self.unit != "number";
        self.words.clone().map(|word| if quoted { format!("`\"{word}\"`") } else { word })
    }
}

/// Serializes limits for JSON.
pub(super) mod plain {
    use serde::{Deserialize, Deserializer, Serializer};

    use super::Unit;

    pub(in super::super) fn serialize<T: Unit, S: Serializer>(
        value: &T,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.serialize_u64(value.plain())
    }

    pub(in super::super) fn deserialize<'de, T: Unit, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<T, D::Error> {
        u64::deserialize(deserializer).map(T::of_plain)
    }
}
