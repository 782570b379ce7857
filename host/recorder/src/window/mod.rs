//! Computes the intervals to keep: from triggers to windows, from windows to clips.
//!
//! - An `event` trigger at anchor `a` opens the window `[a - preroll, a + postroll]`, both ends
//!   inclusive. `start` opens one at `a - preroll`, `stop` ends it at its own anchor `+ postroll`.
//! - Windows that share an instant belong to one [`Group`], of any lambdas. A group is one clip, or
//!   several in turn if it is longer than a clip may be.
//! - One group is open at a time. It stays open until no trigger can come whose window would touch
//!   it; a window that does not touch it waits meanwhile. So the groups do not depend on how soon a
//!   trigger comes after its anchor, as long as it comes before the next sample.
//!
//! Nothing here accesses samples or files, or reads a clock: the caller passes the time.

mod group;
mod intervals;
mod machine;

pub use group::Group;
#[cfg(test)]
use machine::STARTED_MAX;
pub use machine::{TriggerOutcome, WindowStep, Windows};

/// The windows of one lambda's `[record]`, in ns.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct WindowRules {
    /// Time from the begin of a window to its anchor.
    pub preroll_ns: i64,
    /// Time from the anchor to the end of a window.
    pub postroll_ns: i64,
    /// Time after a trigger that opened a window in which further ones open none.
    pub cooldown_ns: i64,
}

/// An interval to keep for one lambda.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Window {
    pub lambda: usize,
    /// Stamp of the trigger.
    pub anchor: i64,
    pub from: i64,
    /// Last instant of the interval; `None` until the stop.
    pub to: Option<i64>,
    /// Number of merged windows: overlapping ones of one lambda wait as one.
    pub windows: u64,
}

impl Window {
    fn touches(&self, other: &Window) -> bool {
        other.to.is_none_or(|to| self.from <= to) && self.to.is_none_or(|to| other.from <= to)
    }
}

#[cfg(test)]
pub(crate) mod tests;
