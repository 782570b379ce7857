//! Which part of a drive is replayed.

use gleaner_base::{Exit, Failure, nanoseconds};
use gleaner_drives::Replay;
use gleaner_journal::Part;
use gleaner_protocol::DriveTime;

/// The part that is asked for; it means something once a drive is open.
#[derive(Clone, Copy, Debug, Default)]
pub struct Wanted {
    /// The first time that belongs to it; the drive's start if `None`.
    pub from: Option<DriveTime>,
    /// The first time that does not; the drive's end if `None`.
    pub to: Option<DriveTime>,
}

impl From<Part> for Wanted {
    fn from(part: Part) -> Self {
        Self { from: part.from_ns.map(DriveTime::At), to: part.to_ns.map(DriveTime::At) }
    }
}

impl Wanted {
    /// Has `drive` replay this part only.
    pub(super) fn restrict(self, drive: &mut Replay) -> Result<Part, Failure> {
        if self.from.is_none() && self.to.is_none() {
            return Ok(Part::default());
        }
        let start_ns = drive.start_ns().unwrap_or(0);
        // Of a database that was cut off, nobody knows it.
        let end_ns = drive.end_ns();
        let ns = |time: DriveTime| match time {
            DriveTime::After(duration) => start_ns.saturating_add(nanoseconds(duration)),
            DriveTime::At(ns) => ns,
        };
        let part = Part { from_ns: self.from.map(ns), to_ns: self.to.map(ns) };
        let (from_ns, to_ns) = (part.from_ns.unwrap_or(start_ns), part.to_ns.unwrap_or(i64::MAX));
        if end_ns.is_some_and(|end_ns| from_ns > end_ns) || to_ns <= start_ns || to_ns <= from_ns {
            return Err(nothing_in(part, start_ns, end_ns));
        }
        drive.restrict(part.from_ns.unwrap_or(0), to_ns);
        Ok(part)
    }
}

fn nothing_in(part: Part, start_ns: i64, end_ns: Option<i64>) -> Failure {
    let seconds = |ns: i64| format!("{:.3} s", ns.saturating_sub(start_ns) as f64 / 1e9);
    let side = |flag: &str, ns: Option<i64>| {
        ns.map(|ns| format!("{flag} is {} after its start", seconds(ns)))
    };
    let asked = [side("--from", part.from_ns), side("--to", part.to_ns)];
    let mut failure =
        Failure::new(Exit::Usage, "the drive has nothing in the part that is asked for");
    failure.causes = vec![asked.into_iter().flatten().collect::<Vec<_>>().join(", ")];
    failure.with_help(format!(
        "the drive is {} long, from @{}.{:09} on",
        end_ns.map_or("?".to_owned(), seconds),
        start_ns.div_euclid(1_000_000_000),
        start_ns.rem_euclid(1_000_000_000)
    ))
}
