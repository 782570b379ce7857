use std::io;

use super::block::PAYLOAD_MAX;
use super::{INPUTS_MAX, Malformed, VERSION};
use gleaner_base::{Exit, Explain};

/// Why a journal cannot be read, or not further.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// It does not begin as one.
    #[error("this is no journal of gleaner")]
    NotAJournal,
    /// It ends before its header is whole, so that nobody knows what it is of.
    #[error("the journal ends after {bytes} bytes, before its header is whole")]
    NoHeader {
        /// Its length.
        bytes: u64,
    },
    /// It is of another version.
    #[error("the journal is of version {found}; this is a reader of version {VERSION}")]
    Version {
        /// Its version.
        found: u16,
    },
    /// The file or stream cannot be read.
    #[error("cannot read the journal")]
    Read {
        /// Why.
        source: io::Error,
    },
    /// Bytes are not those that were written. The wakes before are whole.
    #[error("the journal is damaged in block {block}, at byte {offset}, after {wake} whole wakes")]
    Damaged {
        /// Where the block begins.
        offset: u64,
        /// Its number, from 0; block 0 is the header.
        block: u64,
        /// Index of its first wake, from 0.
        wake: u64,
        /// What is wrong.
        #[source]
        why: Damage,
    },
}

/// What is wrong with a block.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Damage {
    /// Bytes that must be 0 are not.
    #[error("bytes that are reserved are not 0")]
    Reserved,
    /// The head of the block was changed, or is of another block.
    #[error("the checksum of the block's head is wrong")]
    Head,
    /// The payload was changed.
    #[error("the checksum of the block is wrong")]
    Payload,
    /// The block is longer than any that is written.
    #[error("the block has {len} bytes, above the maximum of {PAYLOAD_MAX}")]
    TooLong {
        /// What its head claims.
        len: u32,
    },
    /// The first block is none with a header.
    #[error("the first block is of kind {kind} and no header")]
    NotAHeader {
        /// Its kind.
        kind: u8,
    },
    /// A further header stands in the middle.
    #[error("a second header stands in the middle")]
    SecondHeader,
    /// The header or the end is no JSON, or not the one that it should be.
    #[error("its JSON cannot be read: {0}")]
    Json(String),
    /// The header has more inputs than a lambda may have.
    #[error("it has {found} inputs, above the maximum of {INPUTS_MAX}")]
    Inputs {
        /// How many.
        found: usize,
    },
    /// The header says that an input wakes the lambda, and has no such input.
    #[error("the input that wakes the lambda is not there")]
    EventInput,
    /// A wake is none.
    #[error("one of its wakes cannot be read")]
    Wake(#[source] Malformed),
    /// A block of wakes goes on behind the last of them.
    #[error("bytes follow the last wake of the block")]
    AfterWakes,
    /// The file goes on behind its end.
    #[error("bytes follow the end of the journal")]
    AfterEnd,
}

impl Explain for JournalError {
    fn help(&self) -> Option<String> {
        Some(match self {
            JournalError::NotAJournal => {
                "name the file that `gleaner replay --journal FILE` wrote, or a clip".to_owned()
            }
            JournalError::NoHeader { .. } => "its writer died at once: write a new one".to_owned(),
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
