//! Why a drive cannot be opened, or ends early.

use std::io;
use std::path::PathBuf;

/// Why a drive cannot be opened, or ends before its end.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// No file was given.
    #[error("a drive needs at least one .mcap file")]
    NoFiles,
    /// A file cannot be opened.
    #[error("cannot open drive `{path}`")]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A directory was given.
    #[error("`{path}` is a directory; rosbag2 directories are not supported yet, give the .mcap files in it")]
    Directory {
        /// The directory.
        path: PathBuf,
    },
    /// The file does not begin like an MCAP file.
    #[error("`{path}` is not an MCAP file")]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// Two files, or two channels of one, disagree on the type of a topic.
    #[error("topic `{topic}` has type `{first_type}` in `{first}` and `{second_type}` in `{second}`")]
    TypeConflict {
        /// The topic.
        topic: String,
        /// One file.
        first: PathBuf,
        /// Its type there.
        first_type: String,
        /// The other file.
        second: PathBuf,
        /// Its type there.
        second_type: String,
    },
    /// The system failed to read the file; the file itself may be sound.
    #[error("cannot read drive `{path}` at byte {offset}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// What the system said.
        source: io::Error,
    },
    /// The file is damaged. All that [`super::Replay`] promises to deliver first was delivered.
    #[error("drive `{path}` is damaged at byte {offset}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where the damaged record starts, or where the file ends too early.
        offset: u64,
        /// What is wrong there.
        #[source]
        what: Damage,
    },
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
