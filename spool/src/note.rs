//! The counts that a kill would take from a writer, in a file that exists before: a note needs no
//! room, so that it can be written on a full disk.

use crate::format::{GapReason, u64_at, without_crc};

/// Length of the file.
pub(crate) const NOTE_LEN: usize = 69;

/// The state of a stream, as its writer has noted it last.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SpoolNote {
    /// First number that is not acknowledged.
    pub durable: u64,
    /// Number that the next record gets.
    pub next: u64,
    /// Number after the last one that the budget removed and the consumer had not released.
    pub removed: u64,
    /// Records that could not be written, of all writers of the stream so far.
    pub lost: u64,
    /// Further ones, of which no gap record is durable yet.
    pub pending: u64,
    /// Time of the last loss, in ns since 1970, as the clock was set, and its reason.
    pub lost_ns: i64,
    /// See `lost_ns`.
    pub reason: Option<GapReason>,
    /// Time since which writing fails, as `lost_ns`; 0 if it does not.
    pub failing_ns: i64,
    /// Records that wait while writing fails, without gap records; lost if `failing_ns` is 0.
    pub queued: u64,
}

impl SpoolNote {
    pub(crate) fn to_bytes(self) -> Vec<u8> {
        let [lost_ns, failing_ns] = [self.lost_ns, self.failing_ns].map(i64::cast_unsigned);
        let SpoolNote { durable, next, removed, lost, pending, queued, .. } = self;
        let numbers = [durable, next, removed, lost, pending, lost_ns, failing_ns, queued];
        let mut bytes = numbers.map(u64::to_le_bytes).concat();
        bytes.push(self.reason.map_or(0, |reason| reason as u8));
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        bytes
    }

    /// Returns the note, also a shorter one of an earlier version, unless its checksum differs.
    pub(crate) fn parse(bytes: &[u8; NOTE_LEN]) -> Option<SpoolNote> {
        let mut lengths = [NOTE_LEN, 54].into_iter();
        let len = lengths.find(|len| without_crc(&bytes[..*len]).is_some())?;
        let [durable, next, removed, lost, pending, lost_ns, failing_ns, queued] =
            [0, 8, 16, 24, 32, 40, 48, 56].map(|at| u64_at(bytes, at));
        // The earlier version noted whether writing fails, not since when, nor how many wait.
        let numbers = next.saturating_sub(durable).saturating_sub(pending);
        let (failing_ns, queued, reason) = match (len, bytes[49]) {
            (NOTE_LEN, _) => (failing_ns, queued, bytes[64]),
            (_, 0) => (0, 0, bytes[48]),
            _ => (lost_ns.max(1), numbers, bytes[48]),
        };
        let [lost_ns, failing_ns] = [lost_ns, failing_ns].map(u64::cast_signed);
        let reason = GapReason::from_code(reason);
        let counts = SpoolNote { durable, next, removed, lost, pending, ..SpoolNote::default() };
        Some(SpoolNote { lost_ns, reason, failing_ns, queued, ..counts })
    }
}
