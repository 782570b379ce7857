//! Chunks in memory: reads, decompresses, checks, and sorts them by log time.

use std::io::{self, Read};

use zstd::stream::raw::{Decoder as ZstdDecoder, Operation};

use crate::damage::Damage;
use crate::error::ReplayError;
use crate::file::{Channels, FileSegment, SegmentKind};
use crate::options::{DriveLimits, Span};
#[cfg(feature = "bags")]
use crate::records::MESSAGE_HEAD;
use crate::records::{ChunkHead, HEAD, McapRecord, MessageHead, Records, op};
use crate::source::SourceFile;

/// One message of an open segment, in the order of delivery.
#[derive(Copy, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct MessageEntry {
    pub log_time: u64,
    /// 0 in a segment of a database, whose order does not depend on channels.
    pub channel: u16,
    /// Offset of the message record's body in [`OpenSegment::bytes`]; its length precedes it.
    at: u32,
}

/// A segment in memory. Its buffers are reused for the next one.
#[derive(Default)]
pub struct OpenSegment {
    /// The records; bytes beyond `len` are of an earlier, longer segment.
    bytes: Vec<u8>,
    len: usize,
    entries: Vec<MessageEntry>,
    next: usize,
    /// The channels of messages that were left out, as their time is beyond the year 2262; one
    /// entry for each message.
    late: Vec<u16>,
}

impl OpenSegment {
    /// Returns the next message to deliver.
    #[inline]
    pub fn head(&self) -> Option<MessageEntry> {
        self.entries.get(self.next).copied()
    }

    #[inline]
    pub fn advance(&mut self) {
        self.next += 1;
    }

    /// Returns the body of a message record of this segment.
    #[inline]
    pub fn body(&self, entry: MessageEntry) -> &[u8] {
        let at = entry.at as usize;
        // `sort` took `at` from a record that is within `bytes`, with its length.
        let len = self.bytes[..at].last_chunk().map_or(0, |len| u64::from_le_bytes(*len));
        &self.bytes[at..at + len as usize]
    }

    /// Returns the size of the records, in bytes.
    pub fn len(&self) -> usize {
        self.len
    }

    pub fn records(&self) -> Records<'_> {
        Records::new(&self.bytes[..self.len])
    }

    /// Clears the segment, for messages that [`OpenSegment::push`] adds.
    #[cfg(feature = "bags")]
    pub fn clear(&mut self) {
        (self.len, self.next) = (0, 0);
        self.bytes.clear();
        self.entries.clear();
    }

    /// Adds a message after all others, as an MCAP record. Of equal times, the one added first
    /// comes first.
    #[cfg(feature = "bags")]
    pub fn push(&mut self, head: &MessageHead, data: &[u8]) {
        // It fits: messages of a database are limited to the size of a segment, and fill one with
        // little more.
        let at = (self.bytes.len() + HEAD as usize) as u32;
        self.bytes.push(op::MESSAGE);
        self.bytes.extend_from_slice(&((MESSAGE_HEAD + data.len()) as u64).to_le_bytes());
        self.bytes.extend_from_slice(&head.to_bytes());
        self.bytes.extend_from_slice(data);
        self.len = self.bytes.len();
        self.entries.push(MessageEntry { log_time: head.log_time, channel: 0, at });
    }

    /// Takes the channels of messages whose time is too late; one entry for each message.
    pub fn take_late(&mut self) -> Vec<u16> {
        std::mem::take(&mut self.late)
    }

    /// Collects the messages of the channels that `wanted` accepts, and sorts them. The times of
    /// `segment` and the `channels` of the file are checked.
    ///
    /// `wanted` returns `None` for an undefined channel.
    fn sort(
        &mut self,
        segment: &FileSegment,
        channels: &Channels,
        span: Span,
        wanted: impl Fn(u16) -> Option<bool>,
    ) -> Result<(), Damage> {
        let mut entries = std::mem::take(&mut self.entries);
        entries.clear();
        self.next = 0;
        let mut late = Vec::new();
        for record in self.records() {
            let McapRecord { opcode, at, body } = record?;
            if opcode != op::MESSAGE {
                channels.check(opcode, body)?;
                continue;
            }
            let head = message_head(body)?;
            if !(segment.start_time..=segment.end_time).contains(&head.log_time) {
                let (first, last) = (segment.start_time, segment.end_time);
                return Err(Damage::OutsideChunk { found: head.log_time, first, last });
            }
            if !wanted(head.channel).ok_or(Damage::UnknownChannel(head.channel))? {
                continue;
            }
            if i64::try_from(head.log_time).is_err() {
                late.push(head.channel);
            } else if span.holds(head.log_time) {
                // It fits: `Opener::new` limits the size of a segment.
                entries.push(MessageEntry {
                    log_time: head.log_time,
                    channel: head.channel,
                    at: at as u32,
                });
            }
        }
        if !entries.is_sorted() {
            entries.sort_unstable();
        }
        (self.entries, self.late) = (entries, late);
        Ok(())
    }
}

pub fn message_head(body: &[u8]) -> Result<MessageHead, Damage> {
    MessageHead::parse(body).ok_or(Damage::Malformed("a message record is shorter than its header"))
}

/// Reads segments; keeps the decompressor's state between them.
pub struct Opener {
    limits: DriveLimits,
    zstd: Option<ZstdDecoder<'static>>,
    compressed: Vec<u8>,
}

impl Opener {
    pub fn new(limits: DriveLimits) -> Self {
        // Positions in a segment have 32 bits.
        let limits = DriveLimits { chunk_bytes: limits.chunk_bytes.min(1 << 31), ..limits };
        Self { limits, zstd: None, compressed: Vec::new() }
    }

    /// Reads a segment into `into` and sorts the wanted messages of `span` in it.
    pub fn open(
        &mut self,
        source: &mut SourceFile,
        segment: &FileSegment,
        channels: &Channels,
        span: Span,
        wanted: impl Fn(u16) -> Option<bool>,
        into: &mut OpenSegment,
    ) -> Result<(), ReplayError> {
        self.read(source, segment.offset, segment.len, segment.kind, into)?;
        into.sort(segment, channels, span, wanted)
            .map_err(|what| source.damaged(segment.offset, what))
    }

    /// Reads a segment's records into `into`, unsorted.
    pub fn read(
        &mut self,
        source: &mut SourceFile,
        offset: u64,
        len: u64,
        kind: SegmentKind,
        into: &mut OpenSegment,
    ) -> Result<(), ReplayError> {
        into.entries.clear();
        into.next = 0;
        into.len = 0;
        let allowed = self.limits.chunk_bytes;
        let too_large = |claimed| Damage::ChunkTooLarge { claimed, allowed };
        // `len` was checked against the file's length, so it is not just a claim.
        let size = usize::try_from(len).ok().filter(|_| len <= allowed.saturating_add(HEAD + 4096));
        let size = size.ok_or_else(|| source.damaged(offset, too_large(len)))?;
        match kind {
            SegmentKind::Run => {
                into.bytes.resize(size.max(into.bytes.len()), 0);
                source.read(offset, &mut into.bytes[..size])?;
                into.len = size;
                Ok(())
            }
            SegmentKind::Chunk => {
                let mut record = std::mem::take(&mut self.compressed);
                record.resize(size.max(record.len()), 0);
                let result = source.read(offset, &mut record[..size]).and_then(|()| {
                    self.unpack(&record[..size], into).map_err(|what| source.damaged(offset, what))
                });
                self.compressed = record;
                result
            }
        }
    }

    /// Decompresses and checks the chunk record in `record`, including its head.
    fn unpack(&mut self, record: &[u8], into: &mut OpenSegment) -> Result<(), Damage> {
        let Some(Ok(McapRecord { opcode: op::CHUNK, body, .. })) = Records::new(record).next()
        else {
            return Err(Damage::Malformed("there is no chunk at a position of the index"));
        };
        let head =
            ChunkHead::parse(body).ok_or(Damage::Malformed("a chunk's header is truncated"))?;
        let allowed = self.limits.chunk_bytes;
        let size = usize::try_from(head.uncompressed).ok().filter(|size| *size as u64 <= allowed);
        let size = size.ok_or(Damage::ChunkTooLarge { claimed: head.uncompressed, allowed })?;
        let packed = usize::try_from(head.compressed).ok().and_then(|n| body[head.len..].get(..n));
        let packed =
            packed.ok_or(Damage::Malformed("a chunk is shorter than its header claims"))?;
        match head.compression {
            "" if packed.len() == size => {
                into.bytes.resize(size.max(into.bytes.len()), 0);
                into.bytes[..size].copy_from_slice(packed);
            }
            "" => return Err(Damage::Malformed("an uncompressed chunk claims two sizes")),
            "zstd" => self.unzstd(packed, size, &mut into.bytes).map_err(Damage::Inflate)?,
            "lz4" => unlz4(packed, size, &mut into.bytes).map_err(Damage::Inflate)?,
            other => return Err(Damage::Compression(other.chars().take(32).collect())),
        }
        // 0 means that the writer left it out.
        let found = if head.crc == 0 { 0 } else { crc32fast::hash(&into.bytes[..size]) };
        if found != head.crc {
            return Err(Damage::ChunkCrc { expected: head.crc, found });
        }
        into.len = size;
        Ok(())
    }

    fn unzstd(&mut self, mut packed: &[u8], size: usize, out: &mut Vec<u8>) -> io::Result<()> {
        let decoder = match &mut self.zstd {
            Some(decoder) => {
                decoder.reinit()?;
                decoder
            }
            none => none.insert(ZstdDecoder::new()?),
        };
        fill(out, size, packed.len(), |space| {
            let status = decoder.run_on_buffers(packed, space)?;
            packed = &packed[status.bytes_read..];
            // A frame may end, or its header be read, without output: then input was consumed.
            Ok((status.bytes_written, status.bytes_read > 0))
        })
    }
}

fn unlz4(packed: &[u8], size: usize, out: &mut Vec<u8>) -> io::Result<()> {
    let mut decoder = lz4::Decoder::new(packed)?;
    fill(out, size, packed.len(), |space| decoder.read(space).map(|n| (n, false)))
}

/// Fills the first `size` bytes of `out` by calling `inflate`, which returns the number of bytes
/// written and whether it consumed input without output.
///
/// `out` grows with the actual data: until then, `size` is only a claim.
fn fill(
    out: &mut Vec<u8>,
    size: usize,
    packed: usize,
    mut inflate: impl FnMut(&mut [u8]) -> io::Result<(usize, bool)>,
) -> io::Result<()> {
    let mut filled = 0;
    while filled < size {
        if filled == out.len() {
            let room = (out.len() * 2).max(packed.saturating_mul(4)).max(64 * 1024);
            out.resize(room.min(size).max(out.len()), 0);
        }
        let end = out.len().min(size);
        let (wrote, moved) = inflate(&mut out[filled..end])?;
        if wrote == 0 && !moved {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        filled += wrote;
    }
    Ok(())
}
