//! Limits of a recorder, in memory and in a file.

use crate::file::MESSAGE_MAX;

/// Limits that only tests change.
#[derive(Copy, Clone, Debug)]
pub struct RecorderLimits {
    pub message_bytes: usize,
    /// Most triggers that a clip lists; it counts all.
    pub moments: usize,
    /// Most memory for one lambda's part of a journal.
    pub part_bytes: usize,
    /// Most memory for the parts of all lambdas in one clip.
    pub parts_bytes: usize,
    /// Most triggers that wait for their clip. A lambda can trigger often, and windows wait for
    /// minutes.
    pub waiting: usize,
}

impl Default for RecorderLimits {
    fn default() -> RecorderLimits {
        RecorderLimits {
            message_bytes: MESSAGE_MAX,
            moments: 10_000,
            part_bytes: 64 << 20,
            parts_bytes: 256 << 20,
            waiting: 10_000,
        }
    }
}
