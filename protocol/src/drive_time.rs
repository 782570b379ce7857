//! Parses a time in a drive, as a user writes it.

use std::str::FromStr;
use std::time::Duration;

use gleaner_base::parse_duration;

/// A time in a drive, as given by a user.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DriveTime {
    /// Time since its first message.
    After(Duration),
    /// Log time, in ns since 1970.
    At(i64),
}

/// The text is not a [`DriveTime`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "write seconds after the drive's start, as in 12.5 or 2min, \
     or a time since 1970, as in @1700000000.5"
)]
pub struct DriveTimeError;

impl FromStr for DriveTime {
    type Err = DriveTimeError;

    /// Parses seconds, or a duration as in a manifest; after an `@`, since 1970. Exact to the
    /// nanosecond.
    fn from_str(text: &str) -> Result<DriveTime, DriveTimeError> {
        let (since_1970, time) = text.strip_prefix('@').map_or((false, text), |time| (true, time));
        let has_unit = time.ends_with(|c: char| c.is_ascii_alphabetic());
        let seconds = if has_unit { time.to_owned() } else { format!("{time}s") };
        let duration = parse_duration(&seconds).map_err(|_| DriveTimeError)?;
        match since_1970 {
            false => Ok(DriveTime::After(duration)),
            true => {
                i64::try_from(duration.as_nanos()).map(DriveTime::At).map_err(|_| DriveTimeError)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_need_no_unit_and_other_durations_do() {
        let after = |ns| Ok(DriveTime::After(Duration::from_nanos(ns)));
        for (text, ns) in [
            ("0", 0),
            ("12.5", 12_500_000_000),
            ("12.5s", 12_500_000_000),
            ("250ms", 250_000_000),
            ("2min", 120_000_000_000),
            ("1.000000001", 1_000_000_001),
        ] {
            assert_eq!(text.parse(), after(ns), "{text}");
        }
    }

    #[test]
    fn a_time_since_1970_is_exact_to_the_nanosecond() {
        assert_eq!("@1700000000".parse(), Ok(DriveTime::At(1_700_000_000_000_000_000)));
        assert_eq!("@1700000000.123456789".parse(), Ok(DriveTime::At(1_700_000_000_123_456_789)));
    }

    #[test]
    fn invalid_times_are_refused_with_examples() {
        for text in
            ["", "@", "-1", "1m", "12:30", "1e3", "@-5", "@99999999999", "@@1", "1.0000000001", "s"]
        {
            assert_eq!(text.parse::<DriveTime>(), Err(DriveTimeError), "{text}");
        }
        assert!(DriveTimeError.to_string().contains("12.5 or 2min"));
    }
}
