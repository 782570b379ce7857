//! Errors of a spool.

use std::io;
use std::path::PathBuf;

use gleaner_base::{ByteSize, Exit, Explain};

use crate::GapReason;
use crate::format::{BUDGET_MIN, NAME_MAX, VERSION, segment_name};

/// The reason why a spool refuses a record, or cannot be used. `stream` is the name of the stream,
/// and `first` the first sequence number of a segment.
#[derive(Debug, thiserror::Error)]
pub enum SpoolError {
    #[error("`{stream}` is not the name of a stream: it has {} bytes", stream.len())]
    Name { stream: String },
    #[error("the budget of stream `{stream}` is {budget}, below the minimum of {BUDGET_MIN}")]
    Budget { stream: String, budget: ByteSize },
    #[error("cannot use the spool folder `{}`", path.display())]
    Folder { path: PathBuf, source: io::Error },
    /// Another writer has the stream, the process `pid` if the kernel lists it.
    #[error("another writer uses the spool folder `{}`{}", path.display(), by(*pid))]
    Busy { path: PathBuf, pid: Option<u32> },
    /// The segment with this first sequence number cannot be read, or the folder without one.
    #[error("cannot read {} of stream `{stream}`", part(*segment))]
    Read { stream: String, segment: Option<u64>, source: io::Error },
    #[error(
        "segment {first} of stream `{stream}` has version {found}; this gleaner reads {VERSION}"
    )]
    Version { stream: String, first: u64, found: u16 },
    #[error("{} of stream `{stream}` leaves too few numbers", part(Some(*first)))]
    Numbers { stream: String, first: u64 },
    /// A commit failed: records from number `durable` on are not acknowledged. They stay in the
    /// queue.
    #[error("cannot write records {durable} and later of stream `{stream}`")]
    Write { stream: String, durable: u64, source: io::Error },
    /// The payload is longer than one of this stream may be. The record has no number.
    #[error("a record of stream `{stream}` has {bytes} bytes, above the maximum of {most}")]
    TooLong { stream: String, bytes: usize, most: usize },
    /// The queue is full. The record is lost, and counted; a gap record will have its number.
    #[error("record {seq} of stream `{stream}` was refused: {}", refusal(*reason))]
    Refused { stream: String, seq: u64, reason: GapReason },
}

fn by(pid: Option<u32>) -> String {
    pid.map(|pid| format!(", process {pid}")).unwrap_or_default()
}

fn part(segment: Option<u64>) -> String {
    let segment = segment.map(|first| format!("segment `{}`", segment_name(first)));
    segment.unwrap_or_else(|| "the spool".to_owned())
}

fn refusal(reason: GapReason) -> &'static str {
    match reason {
        GapReason::DiskFull => "the disk is full, and so is the queue",
        GapReason::WriteFailed => "writing fails, and the queue is full",
        _ => "the queue is full",
    }
}

impl Explain for SpoolError {
    fn help(&self) -> Option<String> {
        let help = match self {
            SpoolError::Name { .. } => &format!("choose a name of 1 to {NAME_MAX} bytes"),
            SpoolError::Budget { .. } => &format!("set the budget to {BUDGET_MIN} or more"),
            SpoolError::Folder { .. } => {
                "make it a folder of the user that runs the writer, without links"
            }
            SpoolError::Busy { .. } => "end the other writer first",
            SpoolError::Read { segment: Some(_), .. } => {
                "remove it if it is not a segment; otherwise check its owner and the disk"
            }
            SpoolError::Read { segment: None, .. } => {
                "remove what is not a segment, if the cause names it; otherwise check the disk"
            }
            SpoolError::Numbers { .. } => {
                "remove it if it is not a segment; otherwise use another folder"
            }
            SpoolError::Version { .. } => "use the gleaner that wrote it",
            SpoolError::Write { source, .. } if is_full(source) => {
                "free space on the disk, or lower the budgets"
            }
            SpoolError::Write { source, .. } if source.kind() == io::ErrorKind::NotFound => {
                "start the writer again: its folder, or files in it, were removed"
            }
            SpoolError::Write { .. } => "check the disk",
            SpoolError::TooLong { .. } => "split it, or raise the budget",
            SpoolError::Refused { reason: GapReason::QueueFull, .. } => "commit more often",
            SpoolError::Refused { .. } => "free space on the disk, or replace it",
        };
        Some(help.to_owned())
    }

    fn exit(&self) -> Exit {
        match self {
            SpoolError::Name { .. } | SpoolError::Budget { .. } | SpoolError::Version { .. } => {
                Exit::Usage
            }
            _ => Exit::Internal,
        }
    }
}

/// Returns whether `error` means that the disk, or the user's part of it, is full.
pub(crate) fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}
