//! Parses and formats sizes and durations with units.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use gleaner_rules::units::{self, SIZE_RULE, TIME_RULE};
use serde::{Deserialize, Serialize};

use crate::{Exit, Explain};

/// The text is not a size or not a duration.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is not a {what}")]
pub struct UnitError {
    pub text: String,
    /// `size` or `duration`.
    pub what: &'static str,
    /// The expected form, for the help line.
    pub rule: &'static str,
}

impl Explain for UnitError {
    fn help(&self) -> Option<String> {
        Some(self.rule.to_owned())
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// A number of bytes, written `"2 MiB"`, `"512 KiB"`, `"100 B"` or as a plain integer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ByteSize(u64);

impl ByteSize {
    pub const fn new(n: u64) -> ByteSize {
        ByteSize(n)
    }

    /// `n` KiB of 1024 bytes.
    pub const fn kib(n: u64) -> ByteSize {
        ByteSize(n.saturating_mul(1024))
    }

    /// `n` MiB of 1024 KiB.
    pub const fn mib(n: u64) -> ByteSize {
        ByteSize::kib(n.saturating_mul(1024))
    }

    /// `n` GiB of 1024 MiB.
    pub const fn gib(n: u64) -> ByteSize {
        ByteSize::mib(n.saturating_mul(1024))
    }

    pub const fn bytes(self) -> u64 {
        self.0
    }

    /// Returns the number of bytes as a length in memory. No memory size in a manifest exceeds 2
    /// GiB, so that none saturates.
    pub fn as_usize(self) -> usize {
        usize::try_from(self.0).unwrap_or(usize::MAX)
    }
}

impl FromStr for ByteSize {
    type Err = UnitError;

    fn from_str(text: &str) -> Result<ByteSize, UnitError> {
        units::size(text).map(ByteSize).ok_or_else(|| UnitError {
            text: text.to_owned(),
            what: "size",
            rule: SIZE_RULE,
        })
    }
}

impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&units::size_in_words(self.0))
    }
}

/// Parses a duration such as `5s`, `50ms`, `1.5s`, `2min` or `100us`, exact to the nanosecond.
///
/// # Errors
///
/// [`UnitError`] for a text without a unit, of another form, with fractions of a nanosecond, or
/// beyond 584 years.
pub fn parse_duration(text: &str) -> Result<Duration, UnitError> {
    units::duration(text).map(Duration::from_nanos).ok_or_else(|| UnitError {
        text: text.to_owned(),
        what: "duration",
        rule: TIME_RULE,
    })
}

/// Formats `duration` for [`parse_duration`], in the largest unit that gives a whole number:
/// `1500ms`, `5s`, `2min`.
pub fn format_duration(duration: Duration) -> String {
    units::duration_in_words(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_with_and_without_a_space() {
        for (text, bytes) in [
            ("2 MiB", 2 << 20),
            ("64MiB", 64 << 20),
            ("512 KiB", 512 << 10),
            ("100 B", 100),
            ("1 GiB", 1 << 30),
            ("17", 17),
            ("0", 0),
        ] {
            assert_eq!(text.parse(), Ok(ByteSize::new(bytes)), "{text}");
        }
    }

    #[test]
    fn sizes_of_another_form_are_refused() {
        for text in [
            "",
            "MiB",
            "2 MB",
            "2 mib",
            "1.5 MiB",
            "-1 B",
            "+1 B",
            "2  MiB",
            "2 MiB x",
            "99999999999 GiB",
            "1_000 B",
        ] {
            assert_eq!(
                text.parse::<ByteSize>(),
                Err(UnitError { text: text.to_owned(), what: "size", rule: SIZE_RULE }),
                "{text}"
            );
        }
    }

    #[test]
    fn durations_are_read_exactly() {
        for (text, ns) in [
            ("5s", 5_000_000_000),
            ("50ms", 50_000_000),
            ("1.5s", 1_500_000_000),
            ("2min", 120_000_000_000),
            ("100us", 100_000),
            ("1 h", 3_600_000_000_000),
            ("0s", 0),
            ("0.1us", 100),
            ("0.000000001s", 1),
            ("0.3s", 300_000_000),
        ] {
            assert_eq!(parse_duration(text), Ok(Duration::from_nanos(ns)), "{text}");
        }
    }

    #[test]
    fn durations_of_another_form_are_refused() {
        let long = format!("0.{}s", "0".repeat(100));
        for text in [
            "",
            "5",
            "s",
            ".5s",
            "5.s",
            "1.2.3s",
            "-5s",
            "5 sec",
            "0.0000000001s",
            "99999999999999999999s",
            "6000000h",
            "5s ago",
            &long,
        ] {
            assert_eq!(
                parse_duration(text),
                Err(UnitError { text: text.to_owned(), what: "duration", rule: TIME_RULE }),
                "{text}"
            );
        }
    }

    #[test]
    fn formatted_values_parse_back() {
        for (size, text) in [
            (2 << 20, "2 MiB"),
            (1536, "1536 B"),
            (3 << 10, "3 KiB"),
            (0, "0 B"),
            (1 << 30, "1 GiB"),
            ((1 << 20) + (1 << 10), "1025 KiB"),
        ] {
            assert_eq!(ByteSize::new(size).to_string(), text);
            assert_eq!(text.parse(), Ok(ByteSize::new(size)));
        }
        for (ns, text) in [
            (0, "0s"),
            (1_500_000_000, "1500ms"),
            (120_000_000_000, "2min"),
            (1, "1ns"),
            (50_000_000, "50ms"),
        ] {
            assert_eq!(format_duration(Duration::from_nanos(ns)), text);
            assert_eq!(parse_duration(text), Ok(Duration::from_nanos(ns)));
        }
    }
}
