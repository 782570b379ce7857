//! Appends records to a stream, commits them in groups, and keeps the stream within its budget.

use std::collections::VecDeque;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io;
use std::num::NonZeroU8;
use std::path::Path;

use gleaner_base::ByteSize;

use crate::error::is_full;
use crate::format::{
    BUDGET_MIN, BootId, GAP_KIND, GapReason, HEAD_LEN, HEADER_LEN, NAME_MAX, PAYLOAD_MAX,
    SEGMENT_MAX, SEQ_END, SegmentHeader, SpoolGap, SpoolTime,
};
use crate::queue::RecordQueue;
use crate::scan::SegmentScan;
use crate::{SegmentFile, SpoolError, SpoolFolder, SpoolNote, SpoolStorage};

/// Space that a file system takes for a file, at least: a segment counts as a multiple of it.
const BLOCK: u64 = 4096;

/// Maximum number of segments: bounds the time to list a folder of short ones.
const SEGMENTS_MAX: usize = 4096;

#[derive(Debug, Clone)]
pub struct SpoolConfig {
    /// Name of the stream, 1 to [`NAME_MAX`] bytes. All segments have it.
    pub stream: String,
    pub boot: BootId,
    /// Maximum size of all segments, [`BUDGET_MIN`] or more. A segment has an eighth of it, at most
    /// 4 MiB; the queue has half a segment, and a payload half of that, at most [`PAYLOAD_MAX`].
    pub budget: ByteSize,
}

/// Counts of a writer since it was opened, and the state of its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SpoolStatus {
    /// Number that the next record gets.
    pub next: u64,
    /// Bytes of all segments, in whole blocks of 4 KiB.
    pub disk_bytes: u64,
    /// Records that were refused since the queue was full.
    pub refused: u64,
    /// Numbers that the budget removed and the consumer had not released.
    pub removed: u64,
}

/// Appends records to a stream. Only one writer at a time has a stream.
///
/// [`append`](Self::append) keeps a record in a bounded queue; [`commit`](Self::commit) makes the
/// queue durable. The caller decides how often: every 200 ms or 64 KiB for logs, at once for
/// decisions. A writer that is dropped loses its queue. A segment of an earlier writer is never
/// changed, only removed.
#[derive(Debug)]
pub struct SpoolWriter<S: SpoolStorage = SpoolFolder> {
    storage: S,
    config: SpoolConfig,
    /// All segments, the oldest first.
    segments: VecDeque<Segment>,
    active: Option<ActiveSegment<S::File>>,
    queue: RecordQueue,
    next: u64,
    durable: u64,
    /// First number that was refused since the last gap record, and the reason.
    refused: Option<(u64, GapReason)>,
    /// The reason why the last commit failed.
    failure: Option<GapReason>,
    counts: SpoolStatus,
    /// The next note, and the one that is written.
    note: SpoolNote,
    written_note: Option<SpoolNote>,
}

#[derive(Debug)]
struct Segment {
    first: u64,
    bytes: u64,
    /// Number that must be durable before the segment is removed: that of its gap record, or its
    /// own first one if its consumer released it.
    removed_by: Option<u64>,
}

impl Segment {
    fn disk_bytes(&self) -> u64 {
        self.bytes.next_multiple_of(BLOCK)
    }
}

#[derive(Debug)]
struct ActiveSegment<F> {
    file: F,
    salt: u64,
    bytes: u64,
    /// Number after its last record.
    end: u64,
    /// Set once the name of the file is durable.
    named: bool,
}

impl SpoolWriter {
    /// Opens or creates the stream in the folder `path`, and locks it.
    ///
    /// # Errors
    ///
    /// Those of [`SpoolFolder::locked`] and of [`with_storage`](Self::with_storage).
    pub fn open(path: &Path, config: SpoolConfig) -> Result<SpoolWriter, SpoolError> {
        check(&config)?;
        SpoolWriter::with_storage(SpoolFolder::locked(path)?, config)
    }
}

impl<S: SpoolStorage> SpoolWriter<S> {
    /// Opens the stream in `storage`, of which no other writer exists. The numbers continue behind
    /// the last record, also behind one that was never committed but survived.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Name`] or [`SpoolError::Budget`] for a wrong setting; [`SpoolError::Version`]
    /// for a stream of another version; [`SpoolError::Numbers`] if its numbers come to an end;
    /// [`SpoolError::Read`] if it cannot be read or made durable.
    pub fn with_storage(storage: S, config: SpoolConfig) -> Result<SpoolWriter<S>, SpoolError> {
        check(&config)?;
        let stream = || config.stream.clone();
        let failed = |source| SpoolError::Read { stream: stream(), segment: None, source };
        let listed = storage.list().map_err(failed)?;
        let last = listed.last().copied();
        let segment = |(first, bytes)| Segment { first, bytes, removed_by: None };
        let mut writer = SpoolWriter {
            segments: listed.into_iter().map(segment).collect(),
            active: None,
            queue: RecordQueue::default(),
            next: 0,
            durable: 0,
            refused: None,
            failure: None,
            counts: SpoolStatus::default(),
            note: SpoolNote::default(),
            written_note: None,
            storage,
            config,
        };
        writer.note = writer.storage.noted().ok().flatten().unwrap_or_default();
        if let Some((first, _)) = last {
            writer.recover(first)?;
            // No writer uses up the other half.
            if writer.next > SEQ_END / 2 {
                return Err(SpoolError::Numbers { stream: writer.config.stream.clone(), first });
            }
        }
        // Numbers that a disk has lost are used again, and were not released.
        if writer.storage.released().is_ok_and(|released| released > writer.next) {
            let _ = writer.storage.release(writer.durable);
        }
        // Those of numbers that are used again were not removed.
        writer.note.removed = writer.note.removed.min(writer.next);
        writer.mark_taken();
        writer.keep_note();
        Ok(writer)
    }

    /// Counts the records that a writer lost while writing failed, and marks the numbers that it
    /// gave out.
    fn mark_taken(&mut self) {
        let SpoolNote { next, queued, pending, lost_ns, reason, failing_ns, .. } = self.note;
        let Some(reason) = reason.filter(|_| queued + pending > 0) else { return };
        let is_new = queued > 0 && failing_ns != 0;
        self.note.lost_ns = if is_new { SpoolTime::now().wall_ns } else { lost_ns };
        (self.note.pending, self.failure) = (queued + pending, Some(reason));
        // The gap of a torn tail may have all of them.
        if (self.next + 1..SEQ_END / 2).contains(&next) {
            let from = std::mem::replace(&mut self.next, next);
            self.push_gap(from, next - 1, reason);
        }
    }

    /// Notes what a kill would take, if it has changed. A note that cannot be written is lost with
    /// the writer only.
    fn keep_note(&mut self) {
        let is_failing = self.failure.is_some() || self.note.pending > 0;
        self.note.queued = if is_failing { self.queue.appended } else { 0 };
        if is_failing != (self.note.failing_ns != 0) {
            self.note.failing_ns = if is_failing { SpoolTime::now().wall_ns } else { 0 };
        }
        (self.note.durable, self.note.next) = (self.durable, self.next);
        if self.written_note != Some(self.note) {
            self.written_note = self.storage.note(&self.note).is_ok().then_some(self.note);
        }
    }

    /// Finds the next number in the last segment, and marks its torn tail.
    fn recover(&mut self, first: u64) -> Result<(), SpoolError> {
        let stream = self.config.stream.clone();
        let (segment, name) = (Some(first), &stream);
        let failed = |source| SpoolError::Read { stream: name.clone(), segment, source };
        let file = self.storage.open(first).map_err(failed)?;
        let mut scan = SegmentScan::new(file, &stream, first);
        self.next = first;
        while let Some(head) = scan.peek()? {
            // Written whole after the note: at most one group was, so it is in this segment.
            let is_queued = head.seq >= self.note.durable && head.kind != GAP_KIND;
            self.note.queued = self.note.queued.saturating_sub(is_queued.into());
            self.next = head.seq + 1;
            scan.skip(&head);
        }
        // What a killed writer wrote may not be durable yet, but readers get it from now on.
        scan.sync().and_then(|()| self.storage.sync_names()).map_err(failed)?;
        self.durable = self.next;
        // A segment without a header counts its header, which is no record.
        let header = if scan.header.is_some() { 0 } else { HEADER_LEN as u64 };
        let records = scan.torn.saturating_sub(header).div_ceil(HEAD_LEN as u64);
        if records > 0 {
            // None of these numbers is used again, even if they were acknowledged and their bytes
            // changed later.
            let from = self.next;
            self.next += records;
            self.push_gap(from, self.next - 1, GapReason::Torn);
        }
        Ok(())
    }

    /// Adds a record to the queue, and returns its number. It is acknowledged once
    /// [`durable`](Self::durable) is above that number.
    ///
    /// # Errors
    ///
    /// [`SpoolError::TooLong`], and [`SpoolError::Refused`] if the queue is full: then the record
    /// is lost, and so are all others until the next successful commit, which adds a gap record.
    pub fn append(
        &mut self,
        kind: NonZeroU8,
        time: SpoolTime,
        payload: &[u8],
    ) -> Result<u64, SpoolError> {
        let (bytes, most) = (payload.len(), (self.queue_max() / 2).min(PAYLOAD_MAX));
        if bytes > most {
            let stream = self.config.stream.clone();
            return Err(SpoolError::TooLong { stream, bytes, most });
        }
        let (seq, is_full) = (self.next, self.queue.len() + HEAD_LEN + bytes > self.queue_max());
        if self.refused.is_some() || is_full {
            let reason = self.failure.unwrap_or(GapReason::QueueFull);
            let (_, reason) = *self.refused.get_or_insert((seq, reason));
            self.next += 1;
            self.counts.refused += 1;
            self.note.pending += 1;
            (self.note.lost_ns, self.note.reason) = (time.wall_ns, Some(reason));
            self.keep_note();
            let stream = self.config.stream.clone();
            return Err(SpoolError::Refused { stream, seq, reason });
        }
        self.next += 1;
        self.queue.push(seq, kind.get(), time, payload);
        if self.note.failing_ns != 0 {
            self.keep_note();
        }
        Ok(seq)
    }

    /// Makes the queue durable, and returns the first number that is not acknowledged.
    ///
    /// If writing fails, all that is not acknowledged is written once more, to a new segment.
    ///
    /// # Errors
    ///
    /// [`SpoolError::Write`] if that fails, too. The queue is kept, and the next commit writes it
    /// to a new segment.
    pub fn commit(&mut self) -> Result<u64, SpoolError> {
        let mut written = self.write_all();
        if written.is_err() {
            // Neither a write nor a sync is repeated on a file that failed: its content is unknown.
            self.active = None;
            written = self.write_all();
        }
        if let Err(source) = written {
            self.active = None;
            let reason =
                if is_full(&source) { GapReason::DiskFull } else { GapReason::WriteFailed };
            (self.failure, self.note.reason) = (Some(reason), Some(reason));
            self.keep_note();
            let (stream, durable) = (self.config.stream.clone(), self.durable);
            return Err(SpoolError::Write { stream, durable, source });
        }
        self.failure = None;
        self.note.lost += std::mem::take(&mut self.note.pending);
        self.keep_note();
        Ok(self.durable)
    }

    /// Returns the first number that is not acknowledged. All below it are durable, or in a durable
    /// gap.
    pub fn durable(&self) -> u64 {
        self.durable
    }

    /// Returns the bytes in the queue, by which a caller decides to commit.
    pub fn queued_bytes(&self) -> usize {
        self.queue.len()
    }

    pub fn status(&self) -> SpoolStatus {
        let disk_bytes = self.segments.iter().map(Segment::disk_bytes).sum();
        SpoolStatus { next: self.next, disk_bytes, ..self.counts }
    }

    fn segment_max(&self) -> u64 {
        (self.config.budget.bytes() / 8 / BLOCK * BLOCK).min(SEGMENT_MAX)
    }

    fn queue_max(&self) -> usize {
        usize::try_from(self.segment_max() / 2).expect("a segment has at most 4 MiB")
    }

    fn write_all(&mut self) -> io::Result<()> {
        self.flush()?;
        if self.refused.is_some() {
            // Only now, so that a disk that stays full adds one gap and not one for each commit.
            self.mark_refused();
            self.flush()?;
        }
        Ok(())
    }

    fn flush(&mut self) -> io::Result<()> {
        while let Some((first, len)) = self.queue.front() {
            let segment_max = self.segment_max();
            let room = |active: &ActiveSegment<_>| {
                usize::try_from(segment_max.saturating_sub(active.bytes)).unwrap_or(usize::MAX)
            };
            // Refused numbers begin a segment, so that its name has the number after them: a writer
            // that finds damaged bytes counts a number for each 40 of them, and no more.
            let fits = |active: &&mut ActiveSegment<_>| len <= room(active) && first == active.end;
            let Some(active) = self.active.as_mut().filter(fits) else {
                self.begin_segment(first)?;
                continue;
            };
            let group = self.queue.seal_group(room(active), active.salt);
            active.bytes += group.bytes.len() as u64;
            if let Some(newest) = self.segments.back_mut() {
                newest.bytes = active.bytes;
            }
            active.file.append(group.bytes)?;
            active.file.sync()?;
            if !active.named {
                // Not before: readers may have returned records that a failed write left in the
                // former segment. A kill leaves that one, or a segment with all of them.
                self.storage.publish(first)?;
                self.storage.sync_names()?;
                active.named = true;
            }
            if !active.file.is_linked()? {
                return Err(io::Error::new(io::ErrorKind::NotFound, "the segment was removed"));
            }
            let (records, end) = (group.records, group.end);
            (active.end, self.durable) = (end, end);
            self.queue.remove(records);
            self.keep_note();
            self.remove_marked();
        }
        Ok(())
    }

    /// Begins a segment with number `first`, which no segment holds acknowledged.
    fn begin_segment(&mut self, first: u64) -> io::Result<()> {
        self.active = None;
        let file = self.storage.create()?;
        // A segment of the same name had nothing that was acknowledged, and is replaced.
        self.segments.retain(|segment| segment.first != first);
        let bytes = HEADER_LEN as u64;
        self.segments.push_back(Segment { first, bytes, removed_by: None });
        let salt = RandomState::new().build_hasher().finish();
        let mut active = ActiveSegment { file, salt, bytes, end: first, named: false };
        let (stream, boot) = (self.config.stream.clone(), self.config.boot);
        active.file.append(&SegmentHeader { stream, boot, first, salt }.to_bytes())?;
        self.active = Some(active);
        self.make_room();
        Ok(())
    }

    /// Marks the oldest segments for removal until there is room for two more segments: the active
    /// one, and the next one, which is written before its own gap record is durable; and for a
    /// block with a gap record for refused numbers.
    fn make_room(&mut self) {
        let room = self.config.budget.bytes().saturating_sub(2 * self.segment_max() + BLOCK);
        let older = self.segments.len() - 1;
        let kept = |segment: &&Segment| segment.removed_by.is_none();
        let mut bytes: u64 =
            self.segments.iter().take(older).filter(kept).map(Segment::disk_bytes).sum();
        let (from, mut to) = (self.segments.iter().position(|segment| kept(&segment)), None);
        let from = from.unwrap_or(older);
        for index in from..older {
            if bytes <= room && older - index < SEGMENTS_MAX {
                break;
            }
            bytes -= self.segments[index].disk_bytes();
            to = Some(index);
        }
        let Some(to) = to else { return };
        // Records that the consumer has stored elsewhere are no loss.
        let released = self.storage.released().unwrap_or(0);
        let lost = (from..=to).find(|index| self.segments[index + 1].first > released);
        for segment in self.segments.range_mut(from..lost.unwrap_or(to + 1)) {
            segment.removed_by = Some(segment.first);
        }
        let Some(from) = lost else { return };
        // The gap record must not come between refused numbers and their own gap record.
        self.mark_refused();
        let (first, last) = (self.segments[from].first, self.segments[to + 1].first - 1);
        let record = self.push_gap(first, last, GapReason::Budget);
        for segment in self.segments.range_mut(from..=to) {
            segment.removed_by = Some(record);
        }
        self.counts.removed += last - first + 1;
        // Before they are removed: readers give that as the reason.
        self.note.removed = last + 1;
        self.keep_note();
    }

    /// Removes the marked segments once their gap records are durable. One that cannot be removed
    /// stays until the next commit.
    fn remove_marked(&mut self) {
        while let Some(Segment { first, removed_by: Some(record), .. }) = self.segments.front() {
            if *record >= self.durable {
                break;
            }
            match self.storage.remove(*first) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => break,
                _ => self.segments.pop_front(),
            };
        }
    }

    fn mark_refused(&mut self) {
        if let Some((from, reason)) = self.refused.take() {
            self.push_gap(from, self.next - 1, reason);
        }
    }

    /// Queues a gap record, and returns its number. The queue may exceed its maximum for it.
    fn push_gap(&mut self, from: u64, to: u64, reason: GapReason) -> u64 {
        let seq = self.next;
        self.next += 1;
        let gap = SpoolGap { from, to, reason, record: None };
        self.queue.push(seq, GAP_KIND, SpoolTime::now(), &gap.to_payload());
        seq
    }
}

impl<S: SpoolStorage> Drop for SpoolWriter<S> {
    fn drop(&mut self) {
        // Nothing of it waits any longer.
        if let Some(note) = self.written_note.filter(|note| note.queued > 0) {
            let lost_ns = SpoolTime::now().wall_ns;
            let _ = self.storage.note(&SpoolNote { lost_ns, failing_ns: 0, ..note });
        }
    }
}

fn check(config: &SpoolConfig) -> Result<(), SpoolError> {
    let stream = config.stream.clone();
    if !(1..=NAME_MAX).contains(&stream.len()) {
        return Err(SpoolError::Name { stream });
    }
    if config.budget < BUDGET_MIN {
        return Err(SpoolError::Budget { stream, budget: config.budget });
    }
    Ok(())
}
