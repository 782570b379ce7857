//! The counts that a kill would take from a writer, in a file that exists before: a note needs no
//! room, so that it can be written on a full disk.

use crate::format::{GapReason, u64_at};

/// Length of the file.
pub(crate) const NOTE_LEN: usize = 54;

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
    /// True while numbers below `next` are lost with their writer.
    pub is_failing: bool,
}

impl SpoolNote {
    pub(crate) fn to_bytes(self) -> Vec<u8> {
        let numbers = [self.durable, self.next, self.removed, self.lost, self.pending];
        let mut bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        bytes.extend(self.lost_ns.to_le_bytes());
        bytes.extend([self.reason.map_or(0, |reason| reason as u8), self.is_failing.into()]);
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        bytes
    }

    /// Returns the note, unless its checksum differs.
    pub(crate) fn parse(bytes: &[u8; NOTE_LEN]) -> Option<SpoolNote> {
        let (content, crc) = bytes.split_at(NOTE_LEN - 4);
        (crc32fast::hash(content).to_le_bytes() == crc).then(|| SpoolNote {
            durable: u64_at(bytes, 0),
            next: u64_at(bytes, 8),
            removed: u64_at(bytes, 16),
            lost: u64_at(bytes, 24),
            pending: u64_at(bytes, 32),
            lost_ns: u64_at(bytes, 40).cast_signed(),
            reason: GapReason::from_code(bytes[48]),
            is_failing: bytes[49] != 0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_is_read_as_it_was_written_and_not_at_all_if_it_was_changed() {
        let (reason, next) = (Some(GapReason::DiskFull), 1 << 40);
        let note = SpoolNote {
            next,
            lost: 7,
            lost_ns: -1,
            reason,
            is_failing: true,
            removed: 3,
            ..SpoolNote::default()
        };
        let mut bytes: [u8; NOTE_LEN] = note.to_bytes().try_into().unwrap();
        assert_eq!(SpoolNote::parse(&bytes), Some(note));
        bytes[20] ^= 1;
        assert_eq!(SpoolNote::parse(&bytes), None);
        assert_eq!(SpoolNote::parse(&[0; NOTE_LEN]), None);
    }
}
