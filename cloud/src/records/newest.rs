//! Records of several streams of a vehicle, the newest first.

use std::cmp::Reverse;

use super::RecordArchive;
use super::files::ChunkContent;
use crate::error::CloudResult;
use crate::store::{KeptLine, LINE_MAX, NewestRecords, StoredChunk, large_line};

/// Number of rows that are read at a time.
const ROWS: i64 = 256;

#[derive(Debug, Clone)]
pub(crate) struct FoundLine {
    pub(crate) arrival: i64,
    /// The text; empty if it is longer than was asked for.
    pub(crate) line: String,
    pub(crate) bytes: u64,
}

/// The part of a stream that was not read yet: what has arrived before `before`.
#[derive(Debug)]
struct StreamRest {
    stream: String,
    before: i64,
    /// True once all rows were read.
    is_in_chunks: bool,
}

/// Reads streams of a vehicle from the newest record on, one block of one stream at a time.
pub(crate) struct NewestFirst<'c> {
    archive: &'c RecordArchive,
    vehicle: &'c str,
    /// The arrival at which it ends.
    after: i64,
    rests: Vec<StreamRest>,
    most: usize,
    /// The records so far, the newest first: at most `most`.
    pub(crate) found: Vec<FoundLine>,
    pub(crate) read_bytes: u64,
    /// Longest line whose text is read from a row.
    pub(super) longest: i64,
}

impl<'c> NewestFirst<'c> {
    /// Begins with the last record between two arrivals, without both, for at most `most` records.
    pub(crate) fn new(
        archive: &'c RecordArchive,
        vehicle: &'c str,
        streams: impl Iterator<Item = String>,
        (after, before): (i64, i64),
        most: usize,
    ) -> Self {
        let rest = |stream| StreamRest { stream, before, is_in_chunks: false };
        let rests = streams.map(rest).collect();
        let (found, read_bytes, longest) = (Vec::new(), 0, i64::MAX);
        Self { archive, vehicle, after, rests, most, found, read_bytes, longest }
    }

    /// Returns the arrival before which records were not read yet; `None` if all were.
    pub(crate) fn unread_before(&self) -> Option<i64> {
        self.rests.iter().map(|rest| rest.before).max()
    }

    /// Returns whether no further record belongs to the newest ones.
    pub(crate) fn is_done(&self) -> bool {
        let last = self.most.checked_sub(1).and_then(|last| self.found.get(last));
        let is_older = |before| last.is_some_and(|last| last.arrival >= before);
        self.unread_before().is_none_or(is_older)
    }

    /// Reads a block of the stream with the newest unread records, and leaves out a chunk for which
    /// `skip` returns true. `pick` returns whether a record of a stream counts, and may change it.
    /// The line in the place of a chunk that cannot be used always counts.
    pub(crate) async fn step(
        &mut self,
        skip: impl Fn(&StoredChunk) -> bool,
        mut pick: impl FnMut(&str, &mut FoundLine) -> bool,
    ) -> CloudResult<()> {
        let newest = (0..self.rests.len()).max_by_key(|index| self.rests[*index].before);
        let Some(index) = newest else { return Ok(()) };
        let StreamRest { stream, before, is_in_chunks } = &mut self.rests[index];
        let (of, range) = ((self.vehicle, &**stream), (self.after, *before));
        let store = &self.archive.store;
        if !*is_in_chunks {
            let rows = store.rows_before(of, range, (ROWS, self.longest)).await?;
            *is_in_chunks = (rows.len() as i64) < ROWS;
            for (row, bytes) in rows {
                *before = row.arrival;
                self.read_bytes += bytes;
                let mut found = FoundLine { arrival: row.arrival, line: row.line, bytes };
                if pick(stream, &mut found) {
                    self.found.push(found);
                }
            }
        } else if let Some(chunk) = store.chunk_before(of, range).await? {
            if !skip(&chunk) {
                let content = self.archive.chunk_content(of, &chunk).await?;
                let Some(content) = content else { return Ok(()) };
                self.read_bytes += chunk.bytes;
                let found = |KeptLine { arrival, line, .. }: KeptLine| {
                    let bytes = line.len() as u64;
                    FoundLine { arrival, line, bytes }
                };
                match content {
                    // What goes on after this line goes on after the chunk.
                    ChunkContent::Damaged(line) => {
                        let line = KeptLine { arrival: chunk.first_arrival, ..line };
                        self.found.push(found(line));
                    }
                    ChunkContent::Lines(mut lines) => {
                        lines.retain(|it| it.arrival > self.after && it.arrival < *before);
                        let lines = lines.into_iter().map(found);
                        self.found
                            .extend(lines.filter_map(|mut it| pick(stream, &mut it).then_some(it)));
                    }
                }
            }
            *before = chunk.first_arrival;
        } else {
            self.rests.swap_remove(index);
        }
        self.found.sort_unstable_by_key(|found| Reverse(found.arrival));
        self.found.truncate(self.most);
        Ok(())
    }
}

impl RecordArchive {
    /// Returns the newest records of these streams whose arrivals are after `after` and before
    /// `before`: at most `most`.
    pub(crate) async fn newest(
        &self,
        vehicle: &str,
        streams: &[String],
        (after, before): (i64, i64),
        most: usize,
    ) -> CloudResult<NewestRecords> {
        // First the end: what arrives between the queries of two streams comes next time.
        let arrived = self.store.arrived(vehicle).await?;
        let position = arrived.min(before.saturating_sub(1));
        let range = (after, position.saturating_add(1));
        let mut newest = NewestFirst::new(self, vehicle, streams.iter().cloned(), range, most + 1);
        newest.longest = LINE_MAX;
        while !newest.is_done() {
            let pick = |stream: &str, found: &mut FoundLine| {
                if found.bytes > LINE_MAX as u64 {
                    found.line = large_line(stream, found.bytes);
                }
                true
            };
            newest.step(|_| false, pick).await?;
        }
        let mut found = newest.found;
        let has_more = found.len() > most;
        found.truncate(most);
        let oldest_read = found.last().map_or(position, |found| found.arrival);
        let lines = found.into_iter().map(|found| (found.arrival, found.line)).collect();
        Ok(NewestRecords { lines, position: position.max(after), oldest_read, has_more })
    }
}
