//! Kinds and locations of damage.

use std::error::Error;
use std::fmt;
use std::io;

/// Location of damage in a file.
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

/// Kinds of damage of a file.
#[derive(Debug, thiserror::Error)]
pub enum Damage {
    /// A record or a field is truncated.
    #[error("the file ends inside {0}")]
    Truncated(&'static str),
    /// The last record is complete, but the end of a finished file is missing.
    #[error("the file has no footer: it was truncated or never finished, messages may be missing")]
    NoFooter,
    /// A record contradicts itself or other records.
    #[error("{0}")]
    Malformed(&'static str),
    /// A schema or a channel is defined again with other content: its messages would change their
    /// topic or type.
    #[error("{what} {id} is defined again with another {field}{}", in_order(values))]
    Redefined {
        /// "schema" or "channel".
        what: &'static str,
        /// Id of the schema or channel.
        id: u16,
        /// The first field that differs.
        field: &'static str,
        /// First and second value of the field, if they are names; long ones are truncated.
        values: Option<Box<[String; 2]>>,
    },
    /// A message has a log time outside the times of its chunk in the index.
    #[error(
        "a message has log time {found} ns; by its index, the chunk holds {first} to {last} ns"
    )]
    OutsideChunk {
        /// Log time of the message.
        found: u64,
        /// First log time by the index.
        first: u64,
        /// Last log time by the index.
        last: u64,
    },
    /// The summary at the end is unusable. The messages were read without it.
    #[error("the summary is damaged: {0}")]
    Summary(&'static str),
    /// A chunk exceeds the limit.
    #[error("a chunk claims {claimed} bytes; at most {allowed} are allowed")]
    ChunkTooLarge {
        /// The claimed size.
        claimed: u64,
        /// [`super::DriveLimits::chunk_bytes`].
        allowed: u64,
    },
    /// A chunk has an unsupported compression.
    #[error("a chunk is compressed with `{0}`; only zstd and lz4 can be read")]
    Compression(String),
    /// A chunk cannot be decompressed.
    #[error("a chunk cannot be decompressed")]
    Inflate(#[source] io::Error),
    /// The content of a chunk has the wrong checksum.
    #[error("a chunk has checksum {found:08x}, it should have {expected:08x}")]
    ChunkCrc {
        /// The checksum in the chunk's header.
        expected: u32,
        /// The checksum of its content.
        found: u32,
    },
    /// Messages outside chunks have no checksum of their own, and that of the whole file is wrong:
    /// the delivered messages of this file may be wrong.
    #[error("the data section has checksum {found:08x}, it should have {expected:08x}")]
    DataCrc {
        /// The checksum at the end of the data section.
        expected: u32,
        /// The checksum of its content.
        found: u32,
    },
    /// An attachment has the wrong checksum.
    #[error("attachment `{name}` has checksum {found:08x}, it should have {expected:08x}")]
    AttachmentCrc {
        /// The attachment; a long name is truncated.
        name: String,
        /// The checksum after its data.
        expected: u32,
        /// The checksum of its content.
        found: u32,
    },
    /// Metadata records and attachments exceed the caller's limit.
    #[error("its metadata and attachments take more than {allowed} bytes")]
    ExtrasTooLarge {
        /// The limit given to [`super::read_extras`].
        allowed: u64,
    },
    /// There are fewer metadata records or attachments than in the summary.
    #[error("the file should have {expected} {what}; {found} were found")]
    MissingExtras {
        /// "metadata records" or "attachments".
        what: &'static str,
        /// The number in the summary.
        expected: u32,
        /// The number found.
        found: usize,
    },
    /// A message exceeds the limit once it is unpacked.
    #[error("a message of topic `{topic}` is more than {allowed} bytes once unpacked")]
    MessageTooLarge {
        /// The topic.
        topic: String,
        /// [`super::DriveLimits::chunk_bytes`].
        allowed: u64,
    },
    /// A message that is packed by itself cannot be unpacked.
    #[error("a message of topic `{topic}` cannot be unpacked")]
    Unpack {
        /// The topic.
        topic: String,
        /// The cause.
        source: io::Error,
    },
    /// A packed file is truncated or damaged.
    #[error("the file can be unpacked only in part")]
    UnpackedInPart(#[source] io::Error),
    /// A page of a database is invalid.
    #[error("the rest of the database cannot be read")]
    Database(#[source] Box<dyn Error + Send + Sync>),
    /// A database is shorter than its header claims.
    #[error("the database has {found} bytes, it should have {expected}: it was truncated")]
    DatabaseTruncated {
        /// The size that its header claims.
        expected: u64,
        /// The size of the file.
        found: u64,
    },
    /// A message of a database has an undefined topic.
    #[error("a message belongs to topic number {0}, which is not defined")]
    UnknownTopic(i64),
    /// A message has an undefined channel.
    #[error("a message belongs to channel {0}, which is not defined")]
    UnknownChannel(u16),
    /// The file has another number of messages of a topic than its summary.
    #[error("topic `{topic}` should have {expected} messages; {found} were found")]
    Missing {
        /// The topic.
        topic: String,
        /// The number in the summary.
        expected: u64,
        /// The number delivered.
        found: u64,
    },
}

fn in_order(values: &Option<Box<[String; 2]>>) -> String {
    let values = values.as_deref();
    values.map_or_else(String::new, |[first, second]| format!(": first `{first}`, then `{second}`"))
}
