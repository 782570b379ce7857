//! Scans a file for its content, without holding it in memory.
//!
//! The data section is scanned record by record from its start. The summary at the end of a
//! finished file saves most of that: a chunk in its index is skipped unread. Chunks that no index
//! lists, for lack of a summary or by the writer's choice, are opened. So every file is read in the
//! same way, whether it is indexed, truncated, or has no chunks at all, and an index that omits a
//! chunk costs time but no messages.

use std::collections::{BTreeSet, HashMap};

use tracing::warn;

use crate::chunk::{OpenSegment, Opener, message_head};
use crate::damage::Damage;
use crate::error::ReplayError;
use crate::file::{Contents, FileSegment, SegmentKind};
use crate::records::{ChunkIndex, HEAD, MAGIC, MESSAGE_HEAD, MessageHead, head, op};
use crate::source::SourceFile;
use crate::summary::read_tail;

/// Approximate size of the runs in which messages outside chunks are read, in bytes.
const RUN: u64 = 1 << 20;
/// Number of chunks of an index that are compared with their own headers when a file is opened. The
/// headers are far apart: a hard disk needs some milliseconds for each.
const COMPARED: usize = 64;
/// The head of a chunk record, and its first and last time.
const TIMES: u64 = HEAD + 16;
/// Size limit of schema and channel records outside chunks.
const MAX_RECORD: u64 = 16 << 20;

/// Scans `source`. Damage is part of the result; an error is returned only if the file is not MCAP,
/// or if the system cannot read it.
pub fn scan(source: &mut SourceFile, opener: &mut Opener) -> Result<Contents, ReplayError> {
    if source.peek(0, MAGIC.len())? != MAGIC {
        return Err(ReplayError::NotMcap { path: source.path().to_owned() });
    }
    let mut tail = read_tail(source)?;
    if let Some(summary) = &tail.summary
        && let Some(offset) = chunk_of_other_times(source, &summary.chunks)?
    {
        // Then no time of the index can be trusted, so the file is read through, like one without
        // an index.
        tail.damage =
            Some((offset, Damage::Summary("its times of a chunk differ from those in the chunk")));
        tail.summary = None;
    }
    let mut contents = Contents::default();
    let mut index = HashMap::new();
    if let Some(summary) = tail.summary {
        contents.channels = summary.channels;
        contents.messages = summary.messages;
        contents.claimed = true;
        index = summary.chunks;
    }
    let mut scan = FileScan {
        source,
        opener,
        contents,
        index,
        buffer: OpenSegment::default(),
        data_crc: None,
    };
    let mut damage = scan.data_section()?;
    if damage.is_none() && !tail.finished {
        damage = Some((scan.source.len(), Damage::NoFooter));
    }
    if damage.is_none() {
        damage = scan.check_runs()?.or(tail.damage);
    }
    let mut contents = scan.contents;
    if let Some((offset, what)) = &damage {
        warn!(path = %scan.source.path().display(), offset, %what, "drive is damaged");
    }
    contents.damage = damage;
    Ok(contents)
}

/// Finds a chunk with other times in `index` than in its own header: checks the earliest, the
/// latest, and some in between. The others are checked when they are opened; chunks outside the
/// part to replay are not opened.
fn chunk_of_other_times(
    source: &mut SourceFile,
    index: &HashMap<u64, ChunkIndex>,
) -> Result<Option<u64>, ReplayError> {
    let mut chunks: Vec<_> =
        index.values().filter(|chunk| chunk.offset.saturating_add(TIMES) <= source.len()).collect();
    chunks.sort_unstable_by_key(|chunk| chunk.offset);
    let edges = [
        chunks.iter().min_by_key(|chunk| chunk.start_time),
        chunks.iter().max_by_key(|chunk| chunk.end_time),
    ];
    let step = chunks.len().div_ceil(COMPARED).max(1);
    for chunk in edges.into_iter().flatten().chain(chunks.iter().step_by(step)) {
        let mut bytes = [0; TIMES as usize];
        source.read(chunk.offset, &mut bytes)?;
        let times = [chunk.start_time, chunk.end_time];
        let is_chunk = bytes[0] == op::CHUNK;
        let own = [&bytes[HEAD as usize..][..8], &bytes[HEAD as usize + 8..]]
            .map(|bytes| bytes.try_into().map_or(0, u64::from_le_bytes));
        if is_chunk && (own != times || times[0] > times[1]) {
            return Ok(Some(chunk.offset));
        }
    }
    Ok(None)
}

struct FileScan<'a> {
    source: &'a mut SourceFile,
    opener: &'a mut Opener,
    contents: Contents,
    /// Chunks that the summary lists, by offset.
    index: HashMap<u64, ChunkIndex>,
    buffer: OpenSegment,
    /// End of the data section, and the checksum at that position.
    data_crc: Option<(u64, u32)>,
}

enum ScanStep {
    GoOn(u64),
    End,
    Damaged(Damage),
}

impl FileScan<'_> {
    /// Scans to the end of the data section, or to the damage that it returns.
    fn data_section(&mut self) -> Result<Option<(u64, Damage)>, ReplayError> {
        let mut at = MAGIC.len() as u64;
        loop {
            let step = match self.indexed_chunk(at) {
                Some(behind) => ScanStep::GoOn(behind),
                None => match self.record(at) {
                    Ok(step) => step,
                    Err(ReplayError::Damaged { what, .. }) => ScanStep::Damaged(what),
                    Err(error) => return Err(error),
                },
            };
            match step {
                ScanStep::GoOn(behind) => at = behind,
                ScanStep::End => return Ok(None),
                ScanStep::Damaged(what) => return Ok(Some((at, what))),
            }
        }
    }

    /// Notes the chunk at `at` if the summary lists one there, and returns the position after it
    /// and its message indexes.
    fn indexed_chunk(&mut self, at: u64) -> Option<u64> {
        let chunk = self.index.remove(&at)?;
        let behind = at.checked_add(chunk.len)?.checked_add(chunk.index_len)?;
        if chunk.len < HEAD || behind > self.source.len() {
            return None;
        }
        self.contents.segments.push(FileSegment {
            offset: at,
            len: chunk.len,
            start_time: chunk.start_time,
            end_time: chunk.end_time,
            kind: SegmentKind::Chunk,
            channels: (!chunk.channels.is_empty()).then(|| chunk.channels.into()),
        });
        Some(behind)
    }

    fn record(&mut self, at: u64) -> Result<ScanStep, ReplayError> {
        let file_end = self.source.len();
        if at == file_end {
            return Ok(ScanStep::Damaged(Damage::NoFooter));
        }
        let Some((opcode, len)) = head(self.source.peek(at, HEAD as usize)?) else {
            return Ok(ScanStep::Damaged(Damage::Truncated("the head of a record")));
        };
        let end = at.saturating_add(HEAD).saturating_add(len);
        if end > file_end {
            return Ok(ScanStep::Damaged(Damage::Truncated("a record")));
        }
        match opcode {
            0 => Ok(ScanStep::Damaged(Damage::Malformed(
                "a record has kind 0, which does not exist",
            ))),
            op::DATA_END => {
                let body = self.source.peek(at + HEAD, 4)?;
                let crc = body.first_chunk().map_or(0, |crc| u32::from_le_bytes(*crc));
                self.data_crc = Some((at, crc));
                Ok(ScanStep::End)
            }
            op::FOOTER => Ok(ScanStep::End),
            op::SCHEMA | op::CHANNEL if len <= MAX_RECORD => {
                let mut body = vec![0; len as usize];
                self.source.read(at + HEAD, &mut body)?;
                let learned = self.contents.channels.learn(opcode, &body);
                Ok(learned.map_or_else(ScanStep::Damaged, |()| ScanStep::GoOn(end)))
            }
            op::MESSAGE => self.message(at, end),
            op::CHUNK => self.chunk(at, end),
            _ => Ok(ScanStep::GoOn(end)),
        }
    }

    /// Adds a message outside a chunk to the run before it, or begins a run.
    fn message(&mut self, at: u64, end: u64) -> Result<ScanStep, ReplayError> {
        let body = self.source.peek(at + HEAD, MESSAGE_HEAD.min((end - at - HEAD) as usize))?;
        let head = match message_head(body) {
            Ok(head) => head,
            Err(what) => return Ok(ScanStep::Damaged(what)),
        };
        if self.contents.channels.get(head.channel).is_none() {
            return Ok(ScanStep::Damaged(Damage::UnknownChannel(head.channel)));
        }
        let len = end - at;
        match self.contents.segments.last_mut() {
            Some(run)
                if run.kind == SegmentKind::Run
                    && run.offset + run.len == at
                    && run.len + len <= RUN =>
            {
                run.len += len;
                run.start_time = run.start_time.min(head.log_time);
                run.end_time = run.end_time.max(head.log_time);
            }
            _ => self.contents.segments.push(FileSegment {
                offset: at,
                len,
                start_time: head.log_time,
                end_time: head.log_time,
                kind: SegmentKind::Run,
                channels: None,
            }),
        }
        self.count([head]);
        Ok(ScanStep::GoOn(end))
    }

    /// Opens a chunk that no index lists, for its channels and times.
    fn chunk(&mut self, at: u64, end: u64) -> Result<ScanStep, ReplayError> {
        let kind = SegmentKind::Chunk;
        self.opener.read(self.source, at, end - at, kind, &mut self.buffer)?;
        let heads = match self.look_into_buffer() {
            Ok(heads) => heads,
            Err(what) => return Ok(ScanStep::Damaged(what)),
        };
        if heads.is_empty() {
            return Ok(ScanStep::GoOn(end));
        }
        let channels: BTreeSet<u16> = heads.iter().map(|head| head.channel).collect();
        let times = || heads.iter().map(|head| head.log_time);
        self.contents.segments.push(FileSegment {
            offset: at,
            len: end - at,
            start_time: times().min().unwrap_or(0),
            end_time: times().max().unwrap_or(0),
            kind,
            channels: Some(channels.into_iter().collect()),
        });
        self.count(heads);
        Ok(ScanStep::GoOn(end))
    }

    fn look_into_buffer(&mut self) -> Result<Vec<MessageHead>, Damage> {
        let mut heads = Vec::new();
        for record in self.buffer.records() {
            let record = record?;
            if record.opcode == op::MESSAGE {
                let head = message_head(record.body)?;
                if self.contents.channels.get(head.channel).is_none() {
                    return Err(Damage::UnknownChannel(head.channel));
                }
                heads.push(head);
            } else {
                self.contents.channels.learn(record.opcode, record.body)?;
            }
        }
        Ok(heads)
    }

    /// Counts messages, unless the summary did.
    fn count(&mut self, heads: impl IntoIterator<Item = MessageHead>) {
        if !self.contents.claimed {
            for head in heads {
                *self.contents.messages.entry(head.channel).or_default() += 1;
            }
        }
    }

    /// Checks messages outside chunks: only the checksum of the whole data section covers them.
    fn check_runs(&mut self) -> Result<Option<(u64, Damage)>, ReplayError> {
        let has_runs = self.contents.segments.iter().any(|s| s.kind == SegmentKind::Run);
        let Some((end, expected)) = self.data_crc.filter(|(_, crc)| has_runs && *crc != 0) else {
            return Ok(None);
        };
        let found = self.source.checksum(end)?;
        Ok((found != expected).then_some((end, Damage::DataCrc { expected, found })))
    }
}
