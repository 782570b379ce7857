//! The format of a chunk: lines of JSON, compressed by zstd. The first one states what it is, and
//! each other one is `[ARRIVAL,LIFE,SEQ,RECORD]`.

use std::fmt::Write;
use std::io;

use gleaner_protocol::vehicle_api::StreamLine;
use serde::{Deserialize, Serialize};
use serde_json::json;
use zstd::bulk::{compress, decompress};

use super::search::LineFacts;
use crate::store::{KeptLine, StoredChunk, name_in_lines};

const LEVEL: i32 = 3;
/// Longest first line, and most that a line has beside its record.
const HEAD_MAX: u64 = 4096;
const LINE_MORE: u64 = 72;
/// Longest chunk that is read, decompressed: a line has 8 MiB at most, and a chunk the lines of one
/// MiB or a single longer one.
const TEXT_MAX: u64 = 16 << 20;

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct PackedHead {
    gleaner_chunk: u32,
    vehicle: String,
    stream: String,
    /// Random digits: no two files are the same, so that the removal of one cannot be that of
    /// another one that is being made.
    attempt: String,
}

/// Returns the file of a chunk with its entry in the index.
///
/// # Errors
///
/// An error if it cannot be compressed, or there are no lines.
pub(super) fn encode(
    (vehicle, stream): (&str, &str),
    lines: &[KeptLine],
) -> io::Result<(StoredChunk, Vec<u8>)> {
    let (Some(first), Some(last)) = (lines.first(), lines.last()) else {
        return Err(io::ErrorKind::InvalidInput.into());
    };
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(io::Error::other)?;
    let head = PackedHead {
        gleaner_chunk: 1,
        vehicle: vehicle.to_owned(),
        stream: stream.to_owned(),
        attempt: gleaner_base::hex(&bytes),
    };
    let mut text = serde_json::to_string(&head)? + "\n";
    let seqs = || lines.iter().map(|it| it.seq);
    let mut chunk = StoredChunk {
        first_arrival: first.arrival,
        last_arrival: last.arrival,
        first_seq: seqs().min().unwrap_or(0),
        last_seq: seqs().max().unwrap_or(0),
        records: lines.len() as u64,
        ..StoredChunk::default()
    };
    for KeptLine { arrival, life, seq, line } in lines {
        writeln!(text, "[{arrival},{life},{seq},{line}]").map_err(io::Error::other)?;
        chunk.bytes += line.len() as u64;
        let LineFacts { time_ns, level, .. } = LineFacts::of(line);
        chunk.level = chunk.level.max(level as i64);
        if time_ns != 0 {
            let is_first = chunk.first_time == 0;
            chunk.first_time = if is_first { time_ns } else { chunk.first_time.min(time_ns) };
            chunk.last_time = if is_first { time_ns } else { chunk.last_time.max(time_ns) };
        }
    }
    let file = compress(text.as_bytes(), LEVEL)?;
    chunk.stored_bytes = file.len() as u64;
    chunk.sha256 = gleaner_trust::sha256(&file).to_string();
    Ok((chunk, file))
}

/// Returns the lines of a chunk.
///
/// # Errors
///
/// The reason if the file is not the one of the index, or has other records than it states.
pub(super) fn decode(
    (vehicle, stream): (&str, &str),
    chunk: &StoredChunk,
    file: &[u8],
) -> Result<Vec<KeptLine>, String> {
    if gleaner_trust::sha256(file).as_str() != chunk.sha256 {
        return Err("its bytes were changed".to_owned());
    }
    let length = chunk.bytes + chunk.records * LINE_MORE + HEAD_MAX;
    let capacity = usize::try_from(length).ok().filter(|_| length <= TEXT_MAX);
    let text = capacity.ok_or("it is too long")?;
    let text = decompress(file, text).map_err(|_| "it cannot be decompressed")?;
    let text = String::from_utf8(text).map_err(|_| "it is not text")?;
    let mut rows = text.lines();
    let head: Option<PackedHead> = rows.next().and_then(|head| serde_json::from_str(head).ok());
    let is_of = |head: &PackedHead| {
        (head.gleaner_chunk, &*head.vehicle, &*head.stream) == (1, vehicle, stream)
    };
    if !head.is_some_and(|head| is_of(&head)) {
        return Err("it is of another stream, or of a later version of the cloud".to_owned());
    }
    let lines: Option<Vec<_>> = rows.map(row).collect();
    let lines = lines.ok_or("it has a line without a record")?;
    let ends = lines.first().zip(lines.last()).map(|(first, last)| (first.arrival, last.arrival));
    let is_as_stated = ends == Some((chunk.first_arrival, chunk.last_arrival))
        && lines.len() as u64 == chunk.records
        && lines.is_sorted_by(|one, next| one.arrival < next.arrival);
    match is_as_stated {
        true => Ok(lines),
        false => Err("it has other records than the index states".to_owned()),
    }
}

fn row(text: &str) -> Option<KeptLine> {
    let (arrival, rest) = text.strip_prefix('[')?.strip_suffix(']')?.split_once(',')?;
    let (life, rest) = rest.split_once(',')?;
    let (seq, line) = rest.split_once(',')?;
    let line = line.to_owned();
    Some(KeptLine {
        arrival: arrival.parse().ok()?,
        life: life.parse().ok()?,
        seq: seq.parse().ok()?,
        line,
    })
}

/// Returns the line that is read in the place of a chunk that cannot be used.
pub(super) fn damaged(stream: &str, chunk: &StoredChunk, reason: &str) -> KeptLine {
    let reason = format!("the file of their chunk {} cannot be used: {reason}", chunk.sha256);
    let line = StreamLine {
        stream: name_in_lines(stream).to_owned(),
        seq: chunk.first_seq,
        time_ns: chunk.last_time,
        boot_ns: 0,
        boot: String::new(),
        kind: "damaged".to_owned(),
        record: json!({ "to": chunk.last_seq, "records": chunk.records, "reason": reason }),
    };
    KeptLine {
        arrival: chunk.last_arrival,
        life: 0,
        seq: chunk.last_seq,
        line: serde_json::to_string(&line).unwrap_or_default(),
    }
}
