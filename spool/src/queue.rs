//! Records that are not durable yet, encoded and in order.

use std::collections::VecDeque;

use crate::SpoolTime;
use crate::format::{GAP_KIND, HEAD_LEN, RecordHead, seal};

/// Encoded records in one buffer, so that a commit is one write.
#[derive(Debug, Default)]
pub(crate) struct RecordQueue {
    bytes: Vec<u8>,
    /// Number, length in `bytes`, and kind of each record.
    records: VecDeque<(u64, usize, u8)>,
    /// Number of records that are no gap records.
    pub(crate) appended: u64,
}

/// The oldest records that fit into a segment.
pub(crate) struct SealedGroup<'a> {
    pub(crate) bytes: &'a [u8],
    pub(crate) records: usize,
    /// Number after its last record.
    pub(crate) end: u64,
}

impl RecordQueue {
    pub(crate) fn push(&mut self, seq: u64, kind: u8, time: SpoolTime, payload: &[u8]) {
        let payload_crc = crc32fast::hash(payload);
        let head = RecordHead { len: payload.len(), payload_crc, seq, time, kind };
        self.bytes.extend_from_slice(&head.to_bytes());
        self.bytes.extend_from_slice(payload);
        self.records.push_back((seq, HEAD_LEN + payload.len(), kind));
        self.appended += u64::from(kind != GAP_KIND);
    }

    pub(crate) fn len(&self) -> usize {
        self.bytes.len()
    }

    /// Number and length of the oldest record.
    pub(crate) fn front(&self) -> Option<(u64, usize)> {
        self.records.front().map(|(seq, len, _)| (*seq, *len))
    }

    /// Returns the oldest records that fit into `room` bytes and whose numbers are consecutive,
    /// sealed for the segment with `salt`.
    pub(crate) fn seal_group(&mut self, room: usize, salt: u64) -> SealedGroup<'_> {
        let (mut taken, mut records, mut end) = (0, 0, 0);
        for (seq, len, _) in &self.records {
            if taken + len > room || (records > 0 && *seq != end) {
                break;
            }
            seal(&mut self.bytes[taken..], salt);
            (taken, records, end) = (taken + len, records + 1, seq + 1);
        }
        SealedGroup { bytes: &self.bytes[..taken], records, end }
    }

    /// Removes the `count` oldest records.
    pub(crate) fn remove(&mut self, count: usize) {
        let own = self.records.iter().take(count).filter(|(_, _, kind)| *kind != GAP_KIND);
        self.appended -= own.count() as u64;
        let bytes: usize = self.records.drain(..count).map(|(_, len, _)| len).sum();
        self.bytes.drain(..bytes);
    }
}
