//! Plain values that a lambda is given: they hold nothing and ask nobody.

pub use gleaner_rules::schedule::Tick;
use gleaner_transport::Guid;
use serde::{Deserialize, Serialize};

/// What became of a topic's samples since the lambda started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Entered the ring.
    pub received: u64,
    /// Known to be lost before they reached this process; none where the transport cannot know.
    pub lost: Option<u64>,
    /// Left the ring to make room for newer ones.
    pub overwritten: u64,
    /// Refused because every cell was held.
    pub no_slot: u64,
    /// Refused because they exceed `max_size`.
    pub too_big: u64,
    /// Should have woken the lambda and did not.
    pub skipped: u64,
}

/// What makes a sample different from every other one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// ROS topic as the manifest names it.
    pub topic: String,
    /// Who sent it.
    pub writer: Guid,
    /// Rises strictly for each writer.
    pub seq: u64,
}

/// When a sample came to be, in nanoseconds of three clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamps {
    /// When the vehicle received it: the clock that orders everything.
    pub at_ns: i64,
    /// When the writer published it.
    pub publish_ns: i64,
    /// `header.stamp`, where the type starts with a header.
    pub header_ns: Option<i64>,
}

/// One field of the newest samples, oldest first; both lists have the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// [`Stamps::at_ns`] of each sample.
    pub at_ns: Vec<i64>,
    /// The field's values.
    pub values: Vec<f64>,
}

impl Column {
    pub(super) fn with_capacity(len: usize) -> Self {
        Self { at_ns: Vec::with_capacity(len), values: Vec::with_capacity(len) }
    }
}
