//! Errors of reading a journal.

use std::io;

use crate::block::PAYLOAD_MAX;
use crate::{INPUTS_MAX, MalformedWake, VERSION};
use gleaner_base::{Exit, Explain};

/// The reason why a journal cannot be read, or not to its end.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    #[error("the file is not a Gleaner journal")]
    NotAJournal,
    #[error("the journal ends after {bytes} bytes, within its header")]
    NoHeader { bytes: u64 },
    #[error("the journal has format version {found}; this gleaner reads version {VERSION}")]
    Version { found: u16 },
    #[error("cannot read the journal")]
    Read { source: io::Error },
    /// Bytes were changed. The wakes before them are complete.
    #[error("the journal is damaged in block {block}, at byte {offset}, after {wake} wakes")]
    Damaged {
        offset: u64,
        /// Number of the block, from 0; block 0 is the header.
        block: u64,
        /// Index of the first wake in the block, from 0.
        wake: u64,
        #[source]
        why: Damage,
    },
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Damage {
    #[error("reserved bytes are not 0")]
    Reserved,
    /// The head of the block was changed, or belongs to another block.
    #[error("the checksum of the block's head is wrong")]
    Head,
    #[error("the checksum of the block is wrong")]
    Payload,
    #[error("the block has {len} bytes, above the maximum of {PAYLOAD_MAX}")]
    TooLong { len: u32 },
    #[error("the first block has kind {kind} and is not a header")]
    NotAHeader { kind: u8 },
    #[error("the block is a second header")]
    SecondHeader,
    #[error("its JSON cannot be parsed: {0}")]
    Json(String),
    #[error("it has {found} inputs, above the maximum of {INPUTS_MAX}")]
    Inputs { found: usize },
    #[error("the input that wakes the lambda is missing")]
    EventInput,
    #[error("one of its wakes cannot be decoded")]
    Wake(#[source] MalformedWake),
    #[error("bytes follow the last wake of the block")]
    AfterWakes,
    #[error("bytes follow the end of the journal")]
    AfterEnd,
}

impl Explain for JournalError {
    fn help(&self) -> Option<String> {
        let help = match self {
            JournalError::NotAJournal => {
                "name the file that `gleaner replay --journal FILE` wrote, or a clip"
            }
            JournalError::NoHeader { .. } => "its writer died early: write a new one",
            JournalError::Version { found } if *found > VERSION => "use the gleaner that wrote it",
            JournalError::Version { .. } => "use the gleaner that wrote it, or write a new one",
            JournalError::Read { .. } => return None,
            JournalError::Damaged { .. } => {
                "it was changed after it was written: copy it again, or write a new one"
            }
        };
        Some(help.to_owned())
    }

    fn exit(&self) -> Exit {
        match self {
            JournalError::Read { .. } => Exit::Internal,
            _ => Exit::Usage,
        }
    }
}
