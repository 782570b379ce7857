//! Kinds and locations of damage.

use std::error::Error;
use std::fmt;
use std::io;

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum DamageLocation {
    /// Offset of the damaged record, or of the premature end of the file.
    Byte(u64),
    /// After the message of a database with this number; 0 if not even the first can be read.
    Message(i64),
}

impl fmt::Display for DamageLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Byte(offset) => write!(f, "byte {offset}"),
            Self::Message(0) => f.write_str("its first message"),
            Self::Message(number) => write!(f, "the message after number {number}"),
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum Damage {
    #[error("the file ends inside {0}")]
    Truncated(&'static str),
    #[error("the file has no footer: it was truncated or never finished, messages may be missing")]
    NoFooter,
    #[error("{0}")]
    Malformed(&'static str),
    /// A schema or a channel is defined again with other content: its messages would change their
    /// topic or type.
    #[error("{what} {id} is defined again with another {field}{}", in_order(values))]
    Redefined {
        /// "schema" or "channel".
        what: &'static str,
        id: u16,
        field: &'static str,
        /// First and second value of the field, if they are names; long ones are truncated.
        values: Option<Box<[String; 2]>>,
    },
    #[error(
        "a message has log time {found} ns; by its index, the chunk holds {first} to {last} ns"
    )]
    OutsideChunk { found: u64, first: u64, last: u64 },
    /// The summary at the end is unusable. The messages were read without it.
    #[error("the summary is damaged: {0}")]
    Summary(&'static str),
    #[error("a chunk claims {claimed} bytes; at most {allowed} are allowed")]
    ChunkTooLarge {
        claimed: u64,
        /// [`crate::DriveLimits::chunk_bytes`].
        allowed: u64,
    },
    #[error("a chunk is compressed with `{0}`; only zstd and lz4 can be read")]
    Compression(String),
    #[error("a chunk cannot be decompressed")]
    Inflate(#[source] io::Error),
    #[error("a chunk has checksum {found:08x}, it should have {expected:08x}")]
    ChunkCrc { expected: u32, found: u32 },
    /// Messages outside chunks have no checksum of their own, and that of the whole file is wrong:
    /// the delivered messages of this file may be wrong.
    #[error("the data section has checksum {found:08x}, it should have {expected:08x}")]
    DataCrc { expected: u32, found: u32 },
    #[error("attachment `{name}` has checksum {found:08x}, it should have {expected:08x}")]
    AttachmentCrc {
        /// The attachment; a long name is truncated.
        name: String,
        expected: u32,
        found: u32,
    },
    #[error("its metadata and attachments take more than {allowed} bytes")]
    ExtrasTooLarge {
        /// The limit given to [`crate::read_extras`].
        allowed: u64,
    },
    #[error("the file should have {expected} {what}; {found} were found")]
    MissingExtras {
        /// "metadata records" or "attachments".
        what: &'static str,
        expected: u32,
        found: usize,
    },
    #[error("a message of topic `{topic}` is more than {allowed} bytes once unpacked")]
    MessageTooLarge {
        topic: String,
        /// [`crate::DriveLimits::chunk_bytes`].
        allowed: u64,
    },
    #[error("a message of topic `{topic}` cannot be unpacked")]
    Unpack { topic: String, source: io::Error },
    #[error("the file can be unpacked only in part")]
    UnpackedInPart(#[source] io::Error),
    #[error("the rest of the database cannot be read")]
    Database(#[source] Box<dyn Error + Send + Sync>),
    #[error("the database has {found} bytes, it should have {expected}: it was truncated")]
    DatabaseTruncated { expected: u64, found: u64 },
    #[error("a message belongs to topic number {0}, which is not defined")]
    UnknownTopic(i64),
    #[error("a message belongs to channel {0}, which is not defined")]
    UnknownChannel(u16),
    #[error("topic `{topic}` should have {expected} messages; {found} were found")]
    Missing { topic: String, expected: u64, found: u64 },
}

fn in_order(values: &Option<Box<[String; 2]>>) -> String {
    let values = values.as_deref();
    values.map_or_else(String::new, |[first, second]| format!(": first `{first}`, then `{second}`"))
}
