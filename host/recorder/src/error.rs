//! Errors of recording, with messages and help for users.

use std::collections::TryReserveError;
use std::error::Error;
use std::io;
use std::path::PathBuf;

use gleaner_base::safe_file::UnsafePath;
use gleaner_base::{Exit, Explain};
use gleaner_drives::ReplayError;
use gleaner_transport::TransportError;

/// An error of recording, storing or recovering clips.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A folder or a file cannot be created.
    #[error("cannot create `{}`", path.display())]
    Create {
        /// The folder or file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The folder's lock cannot be taken, for a reason other than that another process holds it.
    #[error("cannot lock `{}`", path.display())]
    Lock {
        /// The lock.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// Another process records into the folder.
    #[error("another process records into `{}`", folder.display())]
    Busy {
        /// The folder.
        folder: PathBuf,
    },
    /// A file or a folder cannot be read.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write `{}`", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// Written data may not be on the disk.
    #[error("cannot sync `{}` to disk", path.display())]
    Sync {
        /// The file or folder.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// A complete file cannot be renamed.
    #[error("cannot rename `{}` to `{}`", from.display(), to.display())]
    Rename {
        /// Its temporary name.
        from: PathBuf,
        /// Its final name.
        to: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// A file that is not needed any more cannot be removed.
    #[error("cannot remove `{}`", path.display())]
    Remove {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// A clip is complete, but not in the list of clips; it will be listed when the folder is
    /// opened the next time.
    #[error("cannot list a clip in `{}`", path.display())]
    List {
        /// The list.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The MCAP writer returned an error.
    #[error("cannot write clip `{}`", path.display())]
    Format {
        /// The clip.
        path: PathBuf,
        /// The cause.
        source: Box<mcap::McapError>,
    },
    /// An unfinished clip of a recorder that died cannot be recovered. It is left unchanged.
    #[error("cannot recover the unfinished clip `{}`", path.display())]
    Recover {
        /// The unfinished clip.
        path: PathBuf,
        /// The cause.
        source: Box<RecordError>,
    },
    /// An existing clip cannot be read.
    #[error("cannot read clip `{}`", path.display())]
    Unreadable {
        /// The clip.
        path: PathBuf,
        /// The cause.
        source: Box<ReplayError>,
    },
    /// A topic of an existing clip cannot be read.
    #[error("cannot read a topic of clip `{}`", path.display())]
    Topic {
        /// The clip.
        path: PathBuf,
        /// The cause.
        source: Box<TransportError>,
    },
    /// A file of the preroll cannot be written, read or removed.
    #[error("cannot keep the preroll in `{}`", path.display())]
    Preroll {
        /// The file or folder.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The memory for the preroll cannot be allocated.
    #[error("cannot allocate {} MiB for the preroll", bytes.div_ceil(1 << 20))]
    PrerollMemory {
        /// The requested size in bytes.
        bytes: u64,
        /// The error of the system.
        source: TryReserveError,
    },
    /// The name, type or definitions of a topic are longer than a clip allows.
    #[error("the {what} of topic `{topic}` has {bytes} bytes; a clip has room for {most}")]
    LongTopic {
        /// Its name, or the beginning of it.
        topic: String,
        /// The part that is too long.
        what: &'static str,
        /// Its length in bytes.
        bytes: usize,
        /// The longest that is allowed, in bytes.
        most: usize,
    },
    /// A message or record is larger than a clip can hold.
    #[error(
        "{what} of {bytes} bytes is larger than clip `{}` can hold: {most} bytes",
        path.display()
    )]
    TooLarge {
        /// The clip.
        path: PathBuf,
        /// The kind of data.
        what: &'static str,
        /// Its size in bytes.
        bytes: usize,
        /// The largest that is allowed, in bytes.
        most: usize,
    },
    /// The thread that writes clips cannot be started, or has ended.
    #[error("the thread that writes clips failed")]
    Thread {
        /// The cause.
        source: io::Error,
    },
    /// More topics than a recorder supports.
    #[error("a recorder holds at most {most} topics")]
    TooManyTopics {
        /// The limit.
        most: usize,
    },
    /// The names and types of the topics are longer in total than a recorder supports.
    #[error("the names and types of the recorded topics take more than {} KiB", most >> 10)]
    LongNames {
        /// The limit in bytes.
        most: usize,
    },
    /// More lambdas than a recorder supports; a restarted lambda counts again.
    #[error("a recorder holds at most {most} lambdas, counted with each start")]
    TooManyLambdas {
        /// The limit.
        most: usize,
    },
}

impl RecordError {
    pub(crate) fn is_full_disk(&self) -> bool {
        matches!(self.os_error(), Some(io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded))
    }

    /// The error of the system, anywhere in the chain of causes.
    fn os_error(&self) -> Option<io::ErrorKind> {
        self.io().find(|error| error.raw_os_error().is_some()).map(io::Error::kind)
    }

    /// Returns whether a name is taken by something other than a regular file or folder of this
    /// program.
    fn is_unsafe_path(&self) -> bool {
        self.io().any(|error| UnsafePath::of(error).is_some())
    }

    /// The errors of the file system in the chain of causes.
    fn io(&self) -> impl Iterator<Item = &io::Error> {
        let chain =
            std::iter::successors(Some(self as &(dyn Error + 'static)), |&error| error.source());
        chain.filter_map(|error| error.downcast_ref())
    }
}

impl Explain for RecordError {
    fn help(&self) -> Option<String> {
        let help = match (self, self.os_error()) {
            (Self::Busy { .. }, _) => "wait until it ends, or choose another folder: --out DIR",
            (Self::TooManyTopics { .. } | Self::LongNames { .. }, _) => {
                "record fewer topics: [record] topics in lambda.toml, or --topics of a replay"
            }
            (Self::PrerollMemory { .. }, _) => {
                "use a smaller preroll: preroll_size in lambda.toml, or --preroll-memory BYTES"
            }
            (Self::LongTopic { .. }, _) => "remove the topic from [record]",
            (_, Some(io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)) => {
                "make room on the disk, or choose another folder: --out DIR"
            }
            (_, Some(io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem)) => {
                "choose a folder that you may write to: --out DIR"
            }
            _ if self.is_unsafe_path() => UnsafePath::HELP,
            _ => return None,
        };
        Some(help.to_owned())
    }

    fn exit(&self) -> Exit {
        match self {
            Self::TooManyTopics { .. }
            | Self::LongNames { .. }
            | Self::LongTopic { .. }
            | Self::PrerollMemory { .. } => Exit::Usage,
            _ => Exit::Internal,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ENOSPC: i32 = 28;

    fn full() -> io::Error {
        io::Error::from_raw_os_error(ENOSPC)
    }

    #[test]
    fn a_full_disk_is_explained_at_any_depth_of_the_chain() {
        let write = RecordError::Write { path: "clips/a.mcap.part".into(), source: full() };
        assert_eq!(write.to_string(), "cannot write `clips/a.mcap.part`");
        let format =
            RecordError::Format { path: "a".into(), source: Box::new(mcap::McapError::Io(full())) };
        let recover = RecordError::Recover {
            path: "a".into(),
            source: Box::new(RecordError::Write { path: "b".into(), source: full() }),
        };
        for error in [write, format, recover] {
            let expected = Some("make room on the disk, or choose another folder: --out DIR");
            assert_eq!(error.help().as_deref(), expected);
            assert_eq!(error.exit(), Exit::Internal);
        }
    }

    #[test]
    fn a_folder_in_use_is_named() {
        let error = RecordError::Busy { folder: "out".into() };
        assert_eq!(error.to_string(), "another process records into `out`");
        assert!(error.help().is_some_and(|help| help.contains("--out DIR")));
    }
}
