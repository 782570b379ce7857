//! Errors of reading a journal.

use std::io;

use super::block::PAYLOAD_MAX;
use super::{INPUTS_MAX, MalformedWake, VERSION};
use gleaner_base::{Exit, Explain};

/// The reason why a journal cannot be read, or not to its end.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The file does not begin as a journal.
    #[error("the file is not a Gleaner journal")]
    NotAJournal,
    /// The journal ends within its header.
    #[error("the journal ends after {bytes} bytes, within its header")]
    NoHeader {
        /// Length of the file, in bytes.
        bytes: u64,
    },
    /// The journal has another version of the format.
    #[error("the journal has format version {found}; this gleaner reads version {VERSION}")]
    Version {
        /// Version of the journal.
        found: u16,
    },
    /// The file or stream cannot be read.
    #[error("cannot read the journal")]
    Read {
        /// The cause.
        source: io::Error,
    },
    /// Bytes were changed. The wakes before them are complete.
    #[error("the journal is damaged in block {block}, at byte {offset}, after {wake} wakes")]
    Damaged {
        /// Offset of the block.
        offset: u64,
        /// Number of the block, from 0; block 0 is the header.
        block: u64,
        /// Index of the first wake in the block, from 0.
        wake: u64,
        /// The damage.
        #[source]
        why: Damage,
    },
}

/// The damage of a block.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Damage {
    /// Bytes that must be 0 are not.
    #[error("reserved bytes are not 0")]
    Reserved,
    /// The head of the block was changed, or belongs to another block.
    #[error("the checksum of the block's head is wrong")]
    Head,
    /// The payload was changed.
    #[error("the checksum of the block is wrong")]
    Payload,
    /// The block is too long.
    #[error("the block has {len} bytes, above the maximum of {PAYLOAD_MAX}")]
    TooLong {
        /// The length in its head.
        len: u32,
    },
    /// The first block is not a header.
    #[error("the first block has kind {kind} and is not a header")]
    NotAHeader {
        /// Kind of the block.
        kind: u8,
    },
    /// There is a second header.
    #[error("the block is a second header")]
    SecondHeader,
    /// The header or the end is not the expected JSON.
    #[error("its JSON cannot be parsed: {0}")]
    Json(String),
    /// The header has more inputs than a lambda may have.
    #[error("it has {found} inputs, above the maximum of {INPUTS_MAX}")]
    Inputs {
        /// Number of inputs.
        found: usize,
    },
    /// The header lacks the input that wakes the lambda.
    #[error("the input that wakes the lambda is missing")]
    EventInput,
    /// A wake cannot be decoded.
    #[error("one of its wakes cannot be decoded")]
    Wake(#[source] MalformedWake),
    /// A block of wakes continues after the last wake.
    #[error("bytes follow the last wake of the block")]
    AfterWakes,
    /// The file continues after the end of the journal.
    #[error("bytes follow the end of the journal")]
    AfterEnd,
}

impl Explain for JournalError {
    fn help(&self) -> Option<String> {
        Some(match self {
            JournalError::NotAJournal => {
                "name the file that `gleaner replay --journal FILE` wrote, or a clip".to_owned()
            }
            JournalError::NoHeader { .. } => "its writer died early: write a new one".to_owned(),
            JournalError::Version { found } if *found > VERSION => {
                "use the gleaner that wrote it".to_owned()
            }
            JournalError::Version { .. } => {
                "use the gleaner that wrote it, or write a new one".to_owned()
            }
            JournalError::Read { .. } => return None,
            JournalError::Damaged { .. } => {
                "it was changed after it was written: copy it again, or write a new one".to_owned()
            }
        })
    }

    fn exit(&self) -> Exit {
        match self {
            JournalError::Read { .. } => Exit::Internal,
            _ => Exit::Usage,
        }
    }
}
