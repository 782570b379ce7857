//! Plain values returned to a lambda.

use gleaner_messages::transport::Guid;
pub use gleaner_rules::schedule::Tick;
use serde::{Deserialize, Serialize};

/// Counts of a topic's samples since the lambda started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Samples that entered the ring.
    pub received: u64,
    /// Samples lost before they reached this process; `None` if the transport cannot detect losses.
    pub lost: Option<u64>,
    /// Samples that newer ones replaced in the ring.
    pub overwritten: u64,
    /// Samples refused because every slot was held.
    pub no_slot: u64,
    /// Samples refused because they exceed `max_size`.
    pub too_big: u64,
    /// Samples that should have caused a wake and did not.
    pub skipped: u64,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// ROS topic, as in the manifest.
    pub topic: String,
    pub writer: Guid,
    /// Sequence number, strictly increasing for each writer.
    pub seq: u64,
}

/// Timestamps of a sample, in nanoseconds of three clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamps {
    /// Time of reception by the vehicle: the clock that orders everything.
    pub at_ns: i64,
    /// Time of publication by the writer.
    pub publish_ns: i64,
    /// `header.stamp`, where the type starts with a header.
    pub header_ns: Option<i64>,
}

/// One field of the newest samples, oldest first; both lists have the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// [`Stamps::at_ns`] of each sample.
    pub at_ns: Vec<i64>,
    pub values: Vec<f64>,
}

impl Column {
    pub(super) fn with_capacity(len: usize) -> Self {
        Self { at_ns: Vec::with_capacity(len), values: Vec::with_capacity(len) }
    }
}
