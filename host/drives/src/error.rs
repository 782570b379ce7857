//! Why a drive cannot be opened, or ends early.

use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};

use super::damage::{Damage, Place};

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
    #[error(
        "`{path}` is not an MCAP file, nor a rosbag2 database, nor one of them packed with zstd"
    )]
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
    /// A packed file holds far more than it should, for its size.
    #[error(
        "drive `{path}` unpacks to more than {allowed} bytes, which is far more than a recording of its size holds"
    )]
    UnpacksManyTimes {
        /// The file.
        path: PathBuf,
        /// The most that one of its size may hold.
        allowed: u64,
    },
    /// A packed file holds more than there is room for on the disk.
    #[error(
        "drive `{path}` unpacks to more than {allowed} bytes, which is nine tenths of what is free in `{folder}`"
    )]
    NoRoom {
        /// The file.
        path: PathBuf,
        /// Where its content was to go.
        folder: PathBuf,
        /// The most that may be taken there.
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
    #[error(
        "topic `{topic}` has type `{first_type}` in `{first}` and `{second_type}` in `{second}`"
    )]
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
                format!(
                    "write it anew with `ros2 bag reindex {folder}`, or name the files in the directory themselves"
                )
            }
            Self::Outside { .. } => "name that file itself, if you trust who wrote this".to_owned(),
            Self::Twice { .. } => "its samples would count twice; give each file once".to_owned(),
            Self::Unpack { path, .. } | Self::UnpacksTooLarge { path, .. } => {
                format!("unpack it yourself: zstd -d {}", word(path))
            }
            Self::UnpacksManyTimes { path, .. } => {
                format!("if you trust it, unpack it yourself: zstd -d {}", word(path))
            }
            Self::NoRoom { path, .. } => {
                format!(
                    "make room, or unpack it where there is some: zstd -d {} -o FILE",
                    word(path)
                )
            }
            Self::NotClosed { path, .. } => {
                format!("close it: sqlite3 {} 'PRAGMA wal_checkpoint(TRUNCATE)'", word(path))
            }
            Self::NoTimes { path } => {
                format!(
                    "make one: sqlite3 {} 'CREATE INDEX timestamp_idx ON messages (timestamp ASC)'",
                    word(path)
                )
            }
            Self::Damaged {
                path,
                what: Damage::Database(_) | Damage::DatabaseCutOff { .. },
                ..
            } => {
                let path = word(path);
                format!(
                    "copy the file again if you can; `sqlite3 {path} .recover | sqlite3 NEW.db3` may find more"
                )
            }
            Self::Damaged { .. } => "copy the file again if you can".to_owned(),
            _ => return None,
        })
    }
}

const WHAT_IS_ONE: &str = "a .mcap or .db3 file, or a directory that `ros2 bag record` wrote";

/// A path as one word of a command to paste into a shell: whoever made the drive chose the names in
/// it.
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
            assert!(
                help.starts_with(&format!("make one: sqlite3 {shown} 'CREATE INDEX")),
                "{help}"
            );
        }
    }
}
