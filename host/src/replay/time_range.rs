//! The time range of a drive that is replayed.

use gleaner_base::{Exit, Failure, nanoseconds};
use gleaner_drives::Replay;
use gleaner_journal::TimeRange;
use gleaner_protocol::DriveTime;

/// A requested range, which is resolved once a drive is open.
#[derive(Clone, Copy, Debug, Default)]
pub struct RequestedRange {
    /// Start, inclusive; the drive's start if `None`.
    pub from: Option<DriveTime>,
    /// End, exclusive; the drive's end if `None`.
    pub to: Option<DriveTime>,
}

impl From<TimeRange> for RequestedRange {
    fn from(range: TimeRange) -> Self {
        Self { from: range.from_ns.map(DriveTime::At), to: range.to_ns.map(DriveTime::At) }
    }
}

impl RequestedRange {
    /// Restricts `drive` to this range; returns the range in ns.
    pub(super) fn restrict(self, drive: &mut Replay) -> Result<TimeRange, Failure> {
        if self.from.is_none() && self.to.is_none() {
            return Ok(TimeRange::default());
        }
        let start_ns = drive.start_ns().unwrap_or(0);
        // Unknown for a truncated database.
        let end_ns = drive.end_ns();
        let ns = |time: DriveTime| match time {
            DriveTime::After(duration) => start_ns.saturating_add(nanoseconds(duration)),
            DriveTime::At(ns) => ns,
        };
        let range = TimeRange { from_ns: self.from.map(ns), to_ns: self.to.map(ns) };
        let (from_ns, to_ns) = (range.from_ns.unwrap_or(start_ns), range.to_ns.unwrap_or(i64::MAX));
        if end_ns.is_some_and(|end_ns| from_ns > end_ns) || to_ns <= start_ns || to_ns <= from_ns {
            return Err(nothing_in(range, start_ns, end_ns));
        }
        drive.restrict(range.from_ns.unwrap_or(0), to_ns);
        Ok(range)
    }
}

fn nothing_in(range: TimeRange, start_ns: i64, end_ns: Option<i64>) -> Failure {
    let seconds = |ns: i64| format!("{:.3} s", ns.saturating_sub(start_ns) as f64 / 1e9);
    let side = |flag: &str, ns: Option<i64>| {
        ns.map(|ns| format!("{flag} is {} after its start", seconds(ns)))
    };
    let requested = [side("--from", range.from_ns), side("--to", range.to_ns)];
    let mut failure = Failure::new(Exit::Usage, "the drive has no message in the requested range");
    failure.causes = vec![requested.into_iter().flatten().collect::<Vec<_>>().join(", ")];
    failure.with_help(format!(
        "the drive is {} long, from @{}.{:09} on",
        end_ns.map_or("?".to_owned(), seconds),
        start_ns.div_euclid(1_000_000_000),
        start_ns.rem_euclid(1_000_000_000)
    ))
}
