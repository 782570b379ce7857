//! What is wrong with a damaged file, and where.

use std::error::Error;
use std::fmt;
use std::io;

/// Where a file is damaged.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// Where the damaged record starts, or where the file ends too early.
    Byte(u64),
    /// Behind the message of a database that has this number; 0 if not even the first can be read.
    Message(i64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Byte(offset) => write!(f, "byte {offset}"),
            Self::Message(0) => f.write_str("its first message"),
            Self::Message(number) => write!(f, "the message after number {number}"),
        }
    }
}

/// What is wrong with a damaged file.
#[derive(Debug, thiserror::Error)]
pub enum Damage {
    /// A record or a field is cut off.
    #[error("the file ends inside {0}")]
    Truncated(&'static str),
    /// The last record is whole, but the end that a finished file has is missing.
    #[error("the file has no footer: it was cut off or never finished, messages may be missing")]
    NoFooter,
    /// A record contradicts itself or its surroundings.
    #[error("{0}")]
    Malformed(&'static str),
    /// A schema or a channel is defined a second time, with other content: its messages would
    /// change their topic or type.
    #[error("{what} {id} is defined again with another {field}{}", in_order(values))]
    Redefined {
        /// "schema" or "channel".
        what: &'static str,
        /// Its number.
        id: u16,
        /// The first field that differs.
        field: &'static str,
        /// Its first and its second value, where they are names; long ones are cut.
        values: Option<Box<[String; 2]>>,
    },
    /// A message has a log time that no clock of ours can show.
    #[error("a message has log time {0} ns, which is after the year 2262")]
    Late(u64),
    /// A chunk holds a message from outside of the times that the index says of the chunk.
    #[error(
        "a message has log time {found} ns; by its index, the chunk holds {first} to {last} ns"
    )]
    OutsideChunk {
        /// The message's.
        found: u64,
        /// First log time by the index.
        first: u64,
        /// Last log time by the index.
        last: u64,
    },
    /// The summary at the end is unusable. The messages were read without it.
    #[error("the summary is damaged: {0}")]
    Summary(&'static str),
    /// A chunk is larger than we are ready to hold.
    #[error("a chunk claims {claimed} bytes; at most {allowed} are allowed")]
    ChunkTooLarge {
        /// The size it claims.
        claimed: u64,
        /// [`super::Limits::chunk_bytes`].
        allowed: u64,
    },
    /// A chunk uses a compression that we do not read.
    #[error("a chunk is compressed with `{0}`; only zstd and lz4 can be read")]
    Compression(String),
    /// A chunk cannot be decompressed.
    #[error("a chunk cannot be decompressed")]
    Inflate(#[source] io::Error),
    /// A chunk's content does not have its checksum.
    #[error("a chunk has checksum {found:08x}, it should have {expected:08x}")]
    ChunkCrc {
        /// The checksum in the chunk's header.
        expected: u32,
        /// That of its content.
        found: u32,
    },
    /// The messages outside chunks have no checksum of their own, and that of the whole file is
    /// wrong: what was delivered from this file may be wrong.
    #[error("the data section has checksum {found:08x}, it should have {expected:08x}")]
    DataCrc {
        /// The checksum at the end of the data section.
        expected: u32,
        /// That of its content.
        found: u32,
    },
    /// An attachment does not have its checksum.
    #[error("attachment `{name}` has checksum {found:08x}, it should have {expected:08x}")]
    AttachmentCrc {
        /// The attachment; a long name is cut.
        name: String,
        /// The checksum behind its data.
        expected: u32,
        /// That of its content.
        found: u32,
    },
    /// Metadata records and attachments are larger than the caller is ready to hold.
    #[error("its metadata and attachments take more than {allowed} bytes")]
    ExtrasTooLarge {
        /// The limit given to [`super::read_extras`].
        allowed: u64,
    },
    /// There are fewer metadata records or attachments than the summary counts.
    #[error("the file should have {expected} {what}; {found} were found")]
    MissingExtras {
        /// "metadata records" or "attachments".
        what: &'static str,
        /// The number in the summary.
        expected: u32,
        /// The number found.
        found: usize,
    },
    /// A message is larger than we are ready to hold once it is unpacked.
    #[error("a message of topic `{topic}` is more than {allowed} bytes once unpacked")]
    MessageTooLarge {
        /// The topic.
        topic: String,
        /// [`super::Limits::chunk_bytes`].
        allowed: u64,
    },
    /// A message that is packed by itself cannot be unpacked.
    #[error("a message of topic `{topic}` cannot be unpacked")]
    Unpack {
        /// The topic.
        topic: String,
        /// Why.
        source: io::Error,
    },
    /// A packed file ends, or is damaged, before its content does.
    #[error("the file cannot be unpacked to its end")]
    UnpackedInPart(#[source] io::Error),
    /// A page of a database makes no sense.
    #[error("the database cannot be read on")]
    Database(#[source] Box<dyn Error + Send + Sync>),
    /// A database is shorter than it says.
    #[error("the database has {found} bytes, it should have {expected}: it was cut off")]
    DatabaseCutOff {
        /// The size that its header claims.
        expected: u64,
        /// The size of the file.
        found: u64,
    },
    /// A message of a database names a topic that it does not define.
    #[error("a message belongs to topic number {0}, which is not defined")]
    UnknownTopic(i64),
    /// A message names a channel that the file does not define.
    #[error("a message belongs to channel {0}, which is not defined")]
    UnknownChannel(u16),
    /// A message of a subscribed topic does not begin like CDR.
    #[error("a message of topic `{topic}` begins with {found:02x?}, which is not plain CDR")]
    Encapsulation {
        /// The topic.
        topic: String,
        /// Its first bytes, at most four.
        found: Vec<u8>,
    },
    /// The file ended with fewer, or more, messages of a topic than its summary counts.
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
