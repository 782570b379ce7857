//! Errors of opening and replaying a drive.

use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};

use crate::damage::{Damage, DamageLocation};
use gleaner_base::Exit;

/// Reasons why a drive cannot be opened, or ends early.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    #[error("a drive needs at least one file or rosbag2 directory")]
    NoFiles,
    #[error("cannot open drive `{path}`")]
    Open { path: PathBuf, source: io::Error },
    #[error("`{path}` is a directory, not a file")]
    Directory { path: PathBuf },
    #[error("`{path}` has no metadata.yaml, and no .mcap or .db3 file")]
    NoBag { path: PathBuf },
    #[error("cannot use `{path}`")]
    Metadata { path: PathBuf, source: Box<dyn Error + Send + Sync> },
    #[error("`{metadata}` names `{file}`, which does not exist")]
    NoSuchFile { metadata: PathBuf, file: String },
    /// The metadata of a rosbag2 directory name a file outside of it, by its path or through a
    /// link.
    #[error("`{metadata}` names `{file}`, which is not in its directory")]
    Outside { metadata: PathBuf, file: String },
    #[error("drive `{path}` is given twice")]
    Twice { path: PathBuf },
    #[error("`{path}` is empty: its recorder was ended before it wrote anything")]
    Empty { path: PathBuf },
    #[error(
        "`{path}` is not an MCAP file, nor a rosbag2 database, nor one of them packed with zstd"
    )]
    NotMcap { path: PathBuf },
    #[error("cannot unpack drive `{path}` into `{folder}`")]
    Unpack { path: PathBuf, folder: PathBuf, source: io::Error },
    #[error("with drive `{path}`, the packed files hold more than {allowed} bytes")]
    UnpacksTooLarge {
        path: PathBuf,
        /// [`crate::DriveLimits::unpacked_bytes`].
        allowed: u64,
    },
    #[error(
        "drive `{path}` unpacks to more than {allowed} bytes, \
         far more than a recording of its size"
    )]
    UnpacksManyTimes { path: PathBuf, allowed: u64 },
    #[error(
        "drive `{path}` unpacks to more than {allowed} bytes, \
         nine tenths of the free space in `{folder}`"
    )]
    NoRoom { path: PathBuf, folder: PathBuf, allowed: u64 },
    #[error("cannot use database `{path}`")]
    Database {
        path: PathBuf,
        /// The error of SQLite, or what is missing in the database.
        source: Box<dyn Error + Send + Sync>,
    },
    #[error("database `{path}` was not closed: its newest messages are in `{beside}`")]
    NotClosed { path: PathBuf, beside: PathBuf },
    /// A database has no index of message times. Without one, each search for the next message
    /// would read the whole database.
    #[error("database `{path}` has no index of message times")]
    NoTimes { path: PathBuf },
    #[error("`{path}` is {what}, which this program does not read")]
    NotBuiltIn { path: PathBuf, what: &'static str },
    #[error("`{first}` and `{second}` overlap in time, and both have topic `{topic}`")]
    Overlap {
        /// The topic, or the first of several.
        topic: String,
        first: PathBuf,
        second: PathBuf,
    },
    #[error("these are {} separate drives: {}", drives.len(), list(drives))]
    Separate { drives: Vec<Vec<PathBuf>> },
    /// The system failed to read the file; the file itself may be intact.
    #[error("cannot read drive `{path}` at byte {offset}")]
    Read { path: PathBuf, offset: u64, source: io::Error },
    /// The file is damaged. All messages that [`crate::Replay`] promises were delivered before.
    #[error("drive `{path}` is damaged at {at}")]
    Damaged {
        path: PathBuf,
        at: DamageLocation,
        #[source]
        what: Damage,
    },
    /// The drive cannot be read before the part to replay. That part was replayed in full, without
    /// latched samples from before it.
    #[error("latched samples from before the replayed part are missing")]
    WithoutLatched { source: Box<ReplayError> },
}

impl ReplayError {
    /// Returns what the user can do about it, if anything.
    pub fn help(&self) -> Option<String> {
        Some(match self {
            Self::NoBag { .. } | Self::NoFiles => format!("name {WHAT_IS_ONE}"),
            Self::Open { source, .. } if source.kind() == io::ErrorKind::NotFound => {
                format!("check its name; a drive is {WHAT_IS_ONE}")
            }
            Self::Open { source, .. } if source.kind() == io::ErrorKind::PermissionDenied => {
                "ask its owner for permission to read it".to_owned()
            }
            Self::NotMcap { .. } => {
                format!(
                    "name {WHAT_IS_ONE}; to convert a bag of ROS 1, use `rosbags-convert` of the \
                     Python package rosbags"
                )
            }
            Self::Metadata { path, .. } | Self::NoSuchFile { metadata: path, .. } => {
                let folder = word(path.parent().unwrap_or(path));
                format!(
                    "rewrite it with `ros2 bag reindex {folder}`, \
                     or name the files in the directory themselves"
                )
            }
            Self::Outside { .. } => {
                "name that file itself, if you trust the author of the metadata".to_owned()
            }
            Self::Overlap { .. } => {
                "its samples would be mixed: replay drives of several vehicles one \
                                     by one, or pass --merge if these files are one recording"
                    .to_owned()
            }
            Self::Separate { .. } => {
                "take them one by one, or pass --merge if they are one recording".to_owned()
            }
            Self::Twice { .. } => "its samples would count twice; give each file once".to_owned(),
            Self::Unpack { path, .. } | Self::UnpacksTooLarge { path, .. } => {
                format!("unpack it yourself: zstd -d {}", word(path))
            }
            Self::UnpacksManyTimes { path, .. } => {
                format!("if you trust it, unpack it yourself: zstd -d {}", word(path))
            }
            Self::NoRoom { path, .. } => {
                format!("free disk space, or unpack it elsewhere: zstd -d {} -o FILE", word(path))
            }
            Self::NotClosed { path, .. } => {
                format!("close it: sqlite3 {} 'PRAGMA wal_checkpoint(TRUNCATE)'", word(path))
            }
            Self::NoTimes { path } => {
                format!(
                    "create one: sqlite3 {} 'CREATE INDEX timestamp_idx ON messages (timestamp \
                     ASC)'",
                    word(path)
                )
            }
            Self::Damaged {
                path,
                what: Damage::Database(_) | Damage::DatabaseTruncated { .. },
                ..
            } => {
                let path = word(path);
                format!(
                    "copy the file again if you can; \
                     `sqlite3 {path} .recover | sqlite3 NEW.db3` may find more"
                )
            }
            Self::Damaged {
                what:
                    Damage::ChunkCrc { .. } | Damage::DataCrc { .. } | Damage::AttachmentCrc { .. },
                ..
            } => "its checksum is wrong: copy the file again if you can".to_owned(),
            Self::Damaged {
                path,
                what: Damage::Truncated(_) | Damage::NoFooter | Damage::Summary(_),
                ..
            } => format!(
                "a recorder that was killed leaves such a file; `mcap recover {}` repairs it",
                word(path)
            ),
            Self::WithoutLatched { source } => return source.help(),
            Self::Empty { .. } => "remove it from the command, or from metadata.yaml".to_owned(),
            _ => return None,
        })
    }

    /// Returns the exit of a program that ends with this error.
    pub fn exit(&self) -> Exit {
        match self {
            Self::Damaged { .. } => Exit::DriveDamaged,
            Self::WithoutLatched { source } => source.exit(),
            Self::Read { .. } | Self::Unpack { .. } | Self::NoRoom { .. } => Exit::Internal,
            _ => Exit::Usage,
        }
    }
}

const WHAT_IS_ONE: &str = "a .mcap or .db3 file, or a directory that `ros2 bag record` wrote";

/// Quotes a path as one word of a shell command to paste; the author of the drive chose the names.
fn word(path: &Path) -> String {
    let text = path.to_string_lossy();
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+=:,@%".contains(c);
    // Otherwise it would be an option.
    let here = if text.starts_with('-') { "./" } else { "" };
    if !text.is_empty() && text.chars().all(is_plain) {
        return format!("{here}{text}");
    }
    format!("'{here}{}'", text.replace('\'', "'\\''"))
}

/// Most drives that an error names.
const NAMED: usize = 5;

fn list(drives: &[Vec<PathBuf>]) -> String {
    let named = drives.iter().flat_map(|drive| drive.first()).take(NAMED);
    let named: Vec<_> = named.map(|path| format!("`{}`", path.display())).collect();
    let more = if drives.len() > NAMED { ", ..." } else { "" };
    named.join(", ") + more
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_to_paste_quotes_a_name_as_one_word() {
        for (path, shown) in [
            ("/data/drive_0.db3", "/data/drive_0.db3"),
            ("a b.db3", "'a b.db3'"),
            ("a;rm -r $HOME.db3", "'a;rm -r $HOME.db3'"),
            ("it's.db3", "'it'\\''s.db3'"),
            ("-init.db3", "./-init.db3"),
        ] {
            let help = ReplayError::NoTimes { path: path.into() }.help().unwrap();
            let expected = format!("create one: sqlite3 {shown} 'CREATE INDEX");
            assert!(help.starts_with(&expected), "{help}");
        }
    }
}
