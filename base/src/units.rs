//! Sizes and durations as people write them.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::{Exit, Explain};

/// Why a text is no size or no duration.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is no {what}")]
pub struct UnitError {
    /// The text that was refused.
    pub text: String,
    /// `size` or `duration`.
    pub what: &'static str,
    /// How it is written, for the help line.
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
    /// `n` bytes.
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

    /// The number of bytes.
    pub const fn bytes(self) -> u64 {
        self.0
    }

    /// The number of bytes as a length in memory. No size of memory in a manifest exceeds 2 GiB, so that none saturates.
    pub fn as_usize(self) -> usize {
        usize::try_from(self.0).unwrap_or(usize::MAX)
    }
}

/// Largest first, so that the first that divides a size is the one to show it in.
const SIZE_UNITS: [(&str, u64); 4] = [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10), ("B", 1)];

/// Largest first; a duration is written in any, and shown in the first that divides it.
const TIME_UNITS: [(&str, u64); 6] = [
    ("h", 3_600_000_000_000),
    ("min", 60_000_000_000),
    ("s", 1_000_000_000),
    ("ms", 1_000_000),
    ("us", 1_000),
    ("ns", 1),
];

const SIZE_RULE: &str = "write a whole number and its unit, B, KiB, MiB or GiB, for example \"2 MiB\"";
const TIME_RULE: &str = "write a number and its unit, us, ms, s, min or h, for example \"50ms\" or \"1.5s\"";

/// The number and the unit of `2 MiB` or `2MiB`; without a unit the second is empty.
fn split(text: &str) -> (&str, &str) {
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.' && c != '_').unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    (number, unit.strip_prefix(' ').unwrap_or(unit))
}

impl FromStr for ByteSize {
    type Err = UnitError;

    fn from_str(text: &str) -> Result<ByteSize, UnitError> {
        let (number, unit) = split(text.trim());
        let unit = if unit.is_empty() { "B" } else { unit };
        let bytes = SIZE_UNITS
            .iter()
            .find(|(name, _)| *name == unit)
            .and_then(|(_, factor)| number.parse::<u64>().ok().and_then(|number| number.checked_mul(*factor)));
        bytes.map(ByteSize).ok_or_else(|| UnitError { text: text.to_owned(), what: "size", rule: SIZE_RULE })
    }
}

impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_in_largest_unit(f, self.0, &SIZE_UNITS, " ")
    }
}

/// The duration that a text such as `5s`, `50ms`, `1.5s`, `2min` or `100us` stands for, exact to the nanosecond.
///
/// # Errors
///
/// [`UnitError`] for a text without a unit, of another form, with parts of a nanosecond, or beyond 584 years.
pub fn parse_duration(text: &str) -> Result<Duration, UnitError> {
    let nanoseconds = || {
        let (number, unit) = split(text.trim());
        let (_, factor) = TIME_UNITS.iter().find(|(name, _)| *name == unit)?;
        let (whole, fraction) = number.split_once('.').unwrap_or((number, "0"));
        let whole = digits(whole)?.checked_mul(*factor)?;
        let scale = 10_u64.checked_pow(u32::try_from(fraction.len()).ok()?)?;
        let fraction = u128::from(digits(fraction)?) * u128::from(*factor);
        let scale = u128::from(scale);
        let fraction = (fraction % scale == 0).then_some(fraction / scale)?;
        whole.checked_add(u64::try_from(fraction).ok()?)
    };
    nanoseconds().map(Duration::from_nanos).ok_or_else(|| UnitError {
        text: text.to_owned(),
        what: "duration",
        rule: TIME_RULE,
    })
}

/// Digits and nothing else: `u64::from_str` also takes a sign.
fn digits(text: &str) -> Option<u64> {
    if text.bytes().all(|byte| byte.is_ascii_digit()) { text.parse().ok() } else { None }
}

/// `duration` as [`parse_duration`] reads it, in the largest unit that keeps it whole: `1500ms`, `5s`, `2min`.
pub fn format_duration(duration: Duration) -> String {
    struct Shown(u64);
    impl fmt::Display for Shown {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            match self.0 {
                0 => f.write_str("0s"),
                n => write_in_largest_unit(f, n, &TIME_UNITS, ""),
            }
        }
    }
    Shown(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)).to_string()
}

fn write_in_largest_unit(f: &mut fmt::Formatter<'_>, n: u64, units: &[(&str, u64)], gap: &str) -> fmt::Result {
    let (unit, factor) =
        units.iter().find(|(_, factor)| n != 0 && n.is_multiple_of(*factor)).unwrap_or(&units[units.len() - 1]);
    write!(f, "{}{gap}{unit}", n / factor)
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
        for text in
            ["", "MiB", "2 MB", "2 mib", "1.5 MiB", "-1 B", "+1 B", "2  MiB", "2 MiB x", "99999999999 GiB", "1_000 B"]
        {
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
    fn what_is_shown_reads_back() {
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
        for (ns, text) in
            [(0, "0s"), (1_500_000_000, "1500ms"), (120_000_000_000, "2min"), (1, "1ns"), (50_000_000, "50ms")]
        {
            assert_eq!(format_duration(Duration::from_nanos(ns)), text);
            assert_eq!(parse_duration(text), Ok(Duration::from_nanos(ns)));
        }
    }
}
