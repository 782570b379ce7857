//! Iterates over the records of a stream, across all segments and all damage.

use std::io;
use std::num::NonZeroU8;
use std::ops::ControlFlow;
use std::path::Path;

use crate::format::{BootId, GAP_KIND, GapReason, RecordHead, SpoolGap, SpoolTime};
use crate::scan::SegmentScan;
use crate::{SpoolError, SpoolFolder, SpoolStorage};

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SpoolRecord {
    /// Its number in the stream.
    pub seq: u64,
    pub boot: BootId,
    pub time: SpoolTime,
    /// Its kind, of the caller's choice.
    pub kind: NonZeroU8,
    /// Its content, at most [`PAYLOAD_MAX`](crate::PAYLOAD_MAX) bytes.
    pub payload: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SpoolItem {
    Record(SpoolRecord),
    Gap(SpoolGap),
    /// The last segment ends with bytes that are not a record, since a kill or a power cut
    /// interrupted a commit, or one is in progress. The next writer replaces this by a gap record.
    Torn(TornTail),
}

/// The bytes at the end of the last segment that are not a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TornTail {
    /// First number that they may contain.
    pub from: u64,
    pub bytes: u64,
}

/// Iterates over a stream in the order of its sequence numbers. Each number from the first one on
/// is in a record, in a gap, or is that of a gap record; damage never ends the iteration.
///
/// After `None`, the iterator can be used again: it returns what was written meanwhile. Its memory
/// is bounded by the longest record.
#[derive(Debug)]
pub struct SpoolReader<S: SpoolStorage = SpoolFolder> {
    storage: S,
    stream: String,
    /// The number of the next item; `None` before the first segment was found.
    expected: Option<u64>,
    /// First numbers of the segments, when they were last listed. Listed again only at the end of
    /// the last one, or if one is missing: a writer changes nothing but that end.
    names: Vec<u64>,
    current: Option<OpenSegment<S::File>>,
    /// Set if the hole before the next record is due to changed bytes, not to a missing segment.
    damaged: bool,
    reported: Option<TornTail>,
    /// Set if segments are made durable before they are left.
    keeps_durable: bool,
    /// Set if that failed: what was returned may not be on the disk.
    must_rewind: bool,
}

struct OpenSegment<F> {
    scan: SegmentScan<F>,
    first: u64,
    /// First number of the next segment, if there is one. What this segment has from there on is
    /// superseded: its commit failed, and the next segment has it again.
    next_first: Option<u64>,
    /// Set if it has records that were returned and not made durable since.
    is_unsynced: bool,
    /// Set once its name is durable.
    is_named: bool,
}

impl<F> std::fmt::Debug for OpenSegment<F> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "segment {}", self.first)
    }
}

impl SpoolReader {
    /// Opens the stream in the folder `path`, as [`with_storage`](Self::with_storage) does.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Folder`] if it does not exist or is not a folder.
    pub fn open(path: &Path, stream: &str, from: Option<u64>) -> Result<SpoolReader, SpoolError> {
        Ok(SpoolReader::with_storage(SpoolFolder::readable(path)?, stream, from))
    }
}

impl<S: SpoolStorage> SpoolReader<S> {
    /// Reads `stream` from number `from` on, or from the oldest record that is kept.
    pub fn with_storage(storage: S, stream: &str, from: Option<u64>) -> SpoolReader<S> {
        SpoolReader {
            storage,
            stream: stream.to_owned(),
            expected: from,
            names: Vec::new(),
            current: None,
            damaged: false,
            reported: None,
            keeps_durable: false,
            must_rewind: false,
        }
    }

    /// Lets [`sync`](Self::sync) cover all segments: each is made durable before it is left.
    pub fn keep_durable(&mut self) {
        self.keeps_durable = true;
    }

    /// Makes all that was returned durable, also what its writer has not synced yet. Call it
    /// before records are passed on: a power cut then takes none of them back.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Read`] if it cannot be made durable. Discard what was returned since the last
    /// success, and call [`rewind`](Self::rewind): a second sync of a file proves nothing.
    pub fn sync(&mut self) -> Result<(), SpoolError> {
        if self.must_rewind {
            let source = io::Error::other("records that were read could not be made durable");
            return Err(self.failed(None, source));
        }
        let synced = self.sync_current();
        if synced.is_err() {
            (self.current, self.must_rewind) = (None, true);
        }
        synced
    }

    fn sync_current(&mut self) -> Result<(), SpoolError> {
        let Some(current) = self.current.as_mut().filter(|it| it.is_unsynced) else {
            return Ok(());
        };
        let (first, is_named) = (current.first, current.is_named);
        let names = || if is_named { Ok(()) } else { self.storage.sync_names() };
        // What replaces a segment was durable before, and has all of its records.
        let synced = current.scan.sync().and_then(|()| names());
        (current.is_unsynced, current.is_named) = (false, true);
        synced.map_err(|source| self.failed(Some(first), source))
    }

    /// Continues with number `to`, a former [`position`](Self::position).
    pub fn rewind(&mut self, to: Option<u64>) {
        (self.expected, self.current, self.reported) = (to, None, None);
        (self.damaged, self.must_rewind) = (false, false);
    }

    /// Lets the writer remove segments whose records are all below `before`, without a gap record,
    /// once it needs the room: the consumer has stored them elsewhere.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Read`] if that cannot be written.
    pub fn release(&self, before: u64) -> Result<(), SpoolError> {
        self.storage.release(before).map_err(|source| self.failed(None, source))
    }

    /// Returns the number of the next item; `None` before the first one was found, of a reader that
    /// begins with the oldest.
    pub fn position(&self) -> Option<u64> {
        self.expected
    }

    fn advance(&mut self) -> Result<Option<SpoolItem>, SpoolError> {
        loop {
            let (Some(current), Some(expected)) = (&mut self.current, self.expected) else {
                match self.first_segment()? {
                    Some(first) => self.enter(first)?,
                    None => return Ok(None),
                }
                continue;
            };
            let end = current.next_first.unwrap_or(u64::MAX);
            let item = match current.scan.peek()?.filter(|head| head.seq < end) {
                Some(head) if head.seq < expected => {
                    self.consume(&head);
                    continue;
                }
                Some(head) => Some(self.item(&head, expected)?),
                None => match self.segment_end(expected)? {
                    ControlFlow::Continue(()) => continue,
                    ControlFlow::Break(torn) => torn.map(SpoolItem::Torn),
                },
            };
            return Ok(item);
        }
    }

    /// Returns the last segment that can have the expected number, or the oldest one.
    fn first_segment(&mut self) -> Result<Option<u64>, SpoolError> {
        self.list()?;
        let before = |first: &&u64| self.expected.is_some_and(|expected| **first <= expected);
        Ok(self.names.iter().rfind(before).or(self.names.first()).copied())
    }

    fn list(&mut self) -> Result<(), SpoolError> {
        self.names = self.storage.names().map_err(|source| self.failed(None, source))?;
        Ok(())
    }

    /// Returns the segment after segment `first`, as last listed.
    fn next_segment(&self, first: u64) -> Option<u64> {
        self.names.get(self.names.partition_point(|other| *other <= first)).copied()
    }

    fn enter(&mut self, first: u64) -> Result<(), SpoolError> {
        self.expected.get_or_insert(first);
        let file = match self.storage.open(first) {
            // The writer removed it meanwhile: the next segment is the first one then.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                self.current = None;
                return Ok(());
            }
            other => other.map_err(|source| self.failed(Some(first), source))?,
        };
        let scan = SegmentScan::new(file, &self.stream, first);
        let next_first = self.next_segment(first);
        // Its records may have been returned from a file that it replaces.
        let (is_unsynced, is_named) = (true, false);
        self.current = Some(OpenSegment { scan, first, next_first, is_unsynced, is_named });
        Ok(())
    }

    /// Returns the record, or the gap before it.
    fn item(&mut self, head: &RecordHead, expected: u64) -> Result<SpoolItem, SpoolError> {
        let current = self.current.as_mut().expect("the caller peeked into it");
        current.is_unsynced = true;
        let damaged = self.damaged || current.scan.damaged;
        let boot = current.scan.header.as_ref().expect("it has records").boot;
        let payload = current.scan.payload()?;
        let noted = SpoolGap::parse(&payload, head.seq).filter(|_| head.kind == GAP_KIND);
        // A gap record that follows its gap explains the hole before it.
        let hole_end = match &noted {
            Some(gap) if gap.to + 1 == head.seq => gap.from,
            _ => head.seq,
        };
        if expected < hole_end {
            let noted = self.storage.noted().ok().flatten();
            let reason = match damaged {
                true => GapReason::Damaged,
                false if noted.is_some_and(|it| hole_end <= it.removed) => GapReason::Budget,
                false => GapReason::Missing,
            };
            self.expected = Some(hole_end);
            let gap = SpoolGap { from: expected, to: hole_end - 1, reason, record: None };
            return Ok(SpoolItem::Gap(gap));
        }
        self.consume(head);
        self.expected = Some(head.seq + 1);
        let Some(kind) = NonZeroU8::new(head.kind) else {
            let (seq, record) = (head.seq, Some(head.seq));
            let unknown = SpoolGap { from: seq, to: seq, reason: GapReason::Damaged, record };
            return Ok(SpoolItem::Gap(noted.unwrap_or(unknown)));
        };
        let (seq, time) = (head.seq, head.time);
        Ok(SpoolItem::Record(SpoolRecord { seq, boot, time, kind, payload }))
    }

    fn consume(&mut self, head: &RecordHead) {
        self.damaged = false;
        if let Some(current) = &mut self.current {
            current.scan.skip(head);
        }
    }

    /// Goes to the next segment if there is one. The current one is searched once more after its
    /// successor appeared, for what was written in between. Breaks at the end of the stream, with
    /// a torn tail that was not reported yet.
    fn segment_end(&mut self, expected: u64) -> Result<ControlFlow<Option<TornTail>>, SpoolError> {
        let current = self.current.as_ref().expect("the caller peeked into it");
        if let Some(next) = current.next_first {
            self.damaged |= current.scan.torn > 0 || current.scan.damaged;
            if self.keeps_durable {
                self.sync()?;
            }
            self.enter(next)?;
            return Ok(ControlFlow::Continue(()));
        }
        // Only the last segment may be replaced by another file of its name, so the order is: list,
        // and then look whether it was.
        let first = current.first;
        self.list()?;
        let next = self.next_segment(first);
        let is_listed = self.names.binary_search(&first).is_ok();
        let current = self.current.as_mut().expect("the caller peeked into it");
        if is_listed && !current.scan.is_linked()? {
            self.enter(first)?;
            return Ok(ControlFlow::Continue(()));
        }
        current.next_first = next;
        if next.is_some() {
            return Ok(ControlFlow::Continue(()));
        }
        let torn = TornTail { from: expected, bytes: current.scan.torn };
        let is_new = torn.bytes > 0 && self.reported != Some(torn);
        Ok(ControlFlow::Break(is_new.then(|| *self.reported.insert(torn))))
    }

    fn failed(&self, segment: Option<u64>, source: io::Error) -> SpoolError {
        SpoolError::Read { stream: self.stream.clone(), segment, source }
    }
}

impl<S: SpoolStorage> Iterator for SpoolReader<S> {
    type Item = Result<SpoolItem, SpoolError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.advance().transpose()
    }
}
