//! Why a drive cannot be opened, or ends early.

use std::error::Error;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// Why a drive cannot be opened, or ends before its end.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// No file was given.
    #[error("a drive needs at least one file or rosbag2 directory")]
    NoFiles,
    /// A file cannot be opened.
    #[error("cannot open drive `{path}`")]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A directory is given to who reads a file.
    #[error("`{path}` is a directory, not a file")]
    Directory {
        /// The directory.
        path: PathBuf,
    },
    /// A directory is no rosbag2 directory.
    #[error("`{path}` has no metadata.yaml, and no .mcap or .db3 file")]
    NoBag {
        /// The directory.
        path: PathBuf,
    },
    /// The metadata of a rosbag2 directory cannot be used.
    #[error("cannot use `{path}`")]
    Metadata {
        /// `metadata.yaml`.
        path: PathBuf,
        /// What is wrong with it.
        source: Box<dyn Error + Send + Sync>,
    },
    /// The metadata of a rosbag2 directory name a file that is not there.
    #[error("`{metadata}` names `{file}`, which is not there")]
    NoSuchFile {
        /// `metadata.yaml`.
        metadata: PathBuf,
        /// The file as it is named there.
        file: String,
    },
    /// The metadata of a rosbag2 directory name a file elsewhere, by its path or through a link.
    #[error("`{metadata}` names `{file}`, which is not in its directory")]
    Outside {
        /// `metadata.yaml`.
        metadata: PathBuf,
        /// The file as it is named there.
        file: String,
    },
    /// Two of the paths given lead to one file.
    #[error("drive `{path}` is given twice")]
    Twice {
        /// The file.
        path: PathBuf,
    },
    /// The file does not begin like anything that we read.
    #[error("`{path}` is not an MCAP file, nor a rosbag2 database, nor one of them packed with zstd")]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// A packed file cannot be unpacked.
    #[error("cannot unpack drive `{path}` into `{folder}`")]
    Unpack {
        /// The file.
        path: PathBuf,
        /// Where its content was to go.
        folder: PathBuf,
        /// Why it cannot.
        source: io::Error,
    },
    /// A packed file holds more than we are ready to write.
    #[error("with drive `{path}`, the packed files hold more than {allowed} bytes")]
    UnpacksTooLarge {
        /// The file.
        path: PathBuf,
        /// [`super::Limits::unpacked_bytes`].
        allowed: u64,
    },
    /// A database cannot be read at all.
    #[error("cannot use database `{path}`")]
    Database {
        /// The file.
        path: PathBuf,
        /// What SQLite said, or what of a rosbag2 database is missing.
        source: Box<dyn Error + Send + Sync>,
    },
    /// The newest messages of a database are not in it yet.
    #[error("database `{path}` was not closed: its newest messages are in `{beside}`")]
    NotClosed {
        /// The file.
        path: PathBuf,
        /// Its journal.
        beside: PathBuf,
    },
    /// Without an index, each look for the next message would read the whole database.
    #[error("database `{path}` has no index of the times of its messages")]
    NoTimes {
        /// The file.
        path: PathBuf,
    },
    /// This program was built without what reads rosbag2 directories.
    #[error("`{path}` is {what}, which this program does not read")]
    NotBuiltIn {
        /// The file or directory.
        path: PathBuf,
        /// What it is.
        what: &'static str,
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
    #[error("drive `{path}` is damaged at {at}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where.
        at: Place,
        /// What is wrong there.
        #[source]
        what: Damage,
    },
}

impl ReplayError {
    /// What who gave the drive can do, where there is something.
    pub fn help(&self) -> Option<String> {
        Some(match self {
            Self::NoBag { .. } | Self::NoFiles => format!("name {WHAT_IS_ONE}"),
            Self::Open { source, .. } if source.kind() == io::ErrorKind::NotFound => {
                format!("look at its name; a drive is {WHAT_IS_ONE}")
            }
            Self::Open { source, .. } if source.kind() == io::ErrorKind::PermissionDenied => {
                "have its owner let you read it".to_owned()
            }
            Self::NotMcap { .. } => {
                format!(
                    "name {WHAT_IS_ONE}; a bag of ROS 1 becomes one by `rosbags-convert`, of the Python package rosbags"
                )
            }
            Self::Metadata { path, .. } | Self::NoSuchFile { metadata: path, .. } => {
                let folder = word(path.parent().unwrap_or(path));
                format!("write it anew with `ros2 bag reindex {folder}`, or name the files in the directory themselves")
            }
            Self::Outside { .. } => "name that file itself, if you trust who wrote this".to_owned(),
            Self::Twice { .. } => "its samples would count twice; give each file once".to_owned(),
            Self::Unpack { path, .. } | Self::UnpacksTooLarge { path, .. } => {
                format!("unpack it yourself: zstd -d {}", word(path))
            }
            Self::NotClosed { path, .. } => {
                format!("close it: sqlite3 {} 'PRAGMA wal_checkpoint(TRUNCATE)'", word(path))
            }
            Self::NoTimes { path } => {
                format!("make one: sqlite3 {} 'CREATE INDEX timestamp_idx ON messages (timestamp ASC)'", word(path))
            }
            Self::Damaged { path, what: Damage::Database(_) | Damage::DatabaseCutOff { .. }, .. } => {
                let path = word(path);
                format!("copy the file again if you can; `sqlite3 {path} .recover | sqlite3 NEW.db3` may find more")
            }
            Self::Damaged { .. } => "copy the file again if you can".to_owned(),
            _ => return None,
        })
    }
}

const WHAT_IS_ONE: &str = "a .mcap or .db3 file, or a directory that `ros2 bag record` wrote";

/// A path as one word of a command to paste into a shell: whoever made the drive chose the names in it.
fn word(path: &Path) -> String {
    let text = path.to_string_lossy();
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+=:,@%".contains(c);
    // Else it would be an option.
    let here = if text.starts_with('-') { "./" } else { "" };
    if !text.is_empty() && text.chars().all(is_plain) {
        return format!("{here}{text}");
    }
    format!("'{here}{}'", text.replace('\'', "'\\''"))
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_to_paste_holds_a_name_as_one_word() {
        for (path, shown) in [
            ("/data/drive_0.db3", "/data/drive_0.db3"),
            ("a b.db3", "'a b.db3'"),
            ("a;rm -r $HOME.db3", "'a;rm -r $HOME.db3'"),
            ("it's.db3", "'it'\\''s.db3'"),
            ("-init.db3", "./-init.db3"),
        ] {
            let help = ReplayError::NoTimes { path: path.into() }.help().unwrap();
            assert!(help.starts_with(&format!("make one: sqlite3 {shown} 'CREATE INDEX")), "{help}");
        }
    }
}
