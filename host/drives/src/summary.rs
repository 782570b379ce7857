//! Reads the end of a file: footer and summary, trusted only if they agree with each other.

use std::collections::HashMap;

use crate::damage::Damage;
use crate::error::ReplayError;
use crate::file::Channels;
use crate::records::{ChunkIndex, FOOTER, HEAD, MAGIC, Records, Statistics, head, op};
use crate::source::SourceFile;

/// Size limit of a summary: an index of two million chunks. A file with a larger one is read
/// without it.
const MAX_SUMMARY: u64 = 256 << 20;

pub struct Summary {
    pub channels: Channels,
    /// By their offset in the file.
    pub chunks: HashMap<u64, ChunkIndex>,
    /// Messages per channel.
    pub messages: HashMap<u16, u64>,
}

#[derive(Default)]
pub struct Tail {
    /// Set if footer and closing magic are present: the file was finished.
    pub finished: bool,
    /// A summary that names every channel and every chunk, if the writer added one.
    pub summary: Option<Summary>,
    pub damage: Option<(u64, Damage)>,
}

pub fn read_tail(source: &mut SourceFile) -> Result<Tail, ReplayError> {
    let Some(Footer { at: footer_at, start, crc }) = footer(source)? else {
        return Ok(Tail::default());
    };
    let finished = Tail { finished: true, ..Tail::default() };
    if start == 0 {
        return Ok(finished);
    }
    let damaged = |why| Tail {
        finished: true,
        summary: None,
        damage: Some((start.min(footer_at), Damage::Summary(why))),
    };
    let Some(len) = footer_at.checked_sub(start) else {
        return Ok(damaged("it starts beyond its end"));
    };
    if len > MAX_SUMMARY {
        return Ok(finished);
    }
    // The checksum also covers the footer up to the checksum itself.
    let mut bytes = vec![0; (len + HEAD + 16) as usize];
    source.read(start, &mut bytes)?;
    if crc != 0 && crc32fast::hash(&bytes) != crc {
        return Ok(damaged("it has the wrong checksum"));
    }
    bytes.truncate(len as usize);
    Ok(match parse_summary(&bytes) {
        Ok(summary) => Tail { summary, ..finished },
        Err(_) => damaged("a record in it is malformed"),
    })
}

/// The last record of a finished file.
pub struct Footer {
    pub at: u64,
    /// Start of the summary; 0 if there is none.
    start: u64,
    crc: u32,
}

/// Returns the footer of `source`; `None` if the file is truncated or was never finished.
pub fn footer(source: &mut SourceFile) -> Result<Option<Footer>, ReplayError> {
    let Some(at) = source.len().checked_sub(FOOTER) else {
        return Ok(None);
    };
    let found = parse_footer(source.peek(at, FOOTER as usize)?);
    Ok(found.map(|(start, crc)| Footer { at, start, crc }))
}

/// Parses the footer and the closing magic; returns the start of the summary and its checksum.
fn parse_footer(bytes: &[u8]) -> Option<(u64, u32)> {
    let (record, magic) = bytes.split_at_checked(bytes.len().checked_sub(MAGIC.len())?)?;
    let body = record.get(HEAD as usize..)?;
    if magic != MAGIC || head(record)? != (op::FOOTER, body.len() as u64) {
        return None;
    }
    Some((u64::from_le_bytes(*body.first_chunk()?), u32::from_le_bytes(*body.last_chunk()?)))
}

/// Returns `None` if the summary is incomplete.
fn parse_summary(bytes: &[u8]) -> Result<Option<Summary>, Damage> {
    let malformed = || Damage::Malformed("a summary record is malformed");
    let mut channels = Channels::default();
    let mut chunks = HashMap::new();
    let mut statistics = None;
    for record in Records::new(bytes) {
        let record = record?;
        match record.opcode {
            op::CHUNK_INDEX => {
                let chunk = ChunkIndex::parse(record.body).ok_or_else(malformed)?;
                chunks.insert(chunk.offset, chunk);
            }
            op::STATISTICS => {
                statistics = Some(Statistics::parse(record.body).ok_or_else(malformed)?);
            }
            opcode => channels.learn(opcode, record.body)?,
        }
    }
    let complete = statistics.filter(|statistics| {
        statistics.channels as usize == channels.len() && statistics.chunks as usize == chunks.len()
    });
    Ok(complete.map(|statistics| {
        let messages = statistics.messages.into_iter().collect();
        Summary { channels, chunks, messages }
    }))
}
