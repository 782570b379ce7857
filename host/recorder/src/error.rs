//! Why something cannot be recorded, in the words that a user sees.

use std::collections::TryReserveError;
use std::error::Error;
use std::io;
use std::path::PathBuf;

use gleaner_base::safe_file::UnsafePath;
use gleaner_base::{Exit, Explain};
use gleaner_drives::ReplayError;
use gleaner_transport::TransportError;

/// Why something cannot be recorded, or kept, or found again.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A folder or a file cannot be made.
    #[error("cannot create `{}`", path.display())]
    Create {
        /// What was to be made.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The folder's lock cannot be taken, for a reason other than that somebody has it.
    #[error("cannot lock `{}`", path.display())]
    Lock {
        /// The lock.
        path: PathBuf,
        /// What the system said.
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
        /// What the system said.
        source: io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write `{}`", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// What was written may not be on the disk.
    #[error("cannot make sure that `{}` is on the disk", path.display())]
    Sync {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A whole file cannot be given its name.
    #[error("cannot rename `{}` to `{}`", from.display(), to.display())]
    Rename {
        /// Its name until then.
        from: PathBuf,
        /// The name that it should have.
        to: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file that is not needed any more cannot be removed.
    #[error("cannot remove `{}`", path.display())]
    Remove {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A clip is whole, but the list of clips does not name it; it will when the folder is opened
    /// the next time.
    #[error("cannot list a clip in `{}`", path.display())]
    List {
        /// The list.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The MCAP writer refuses something.
    #[error("cannot write clip `{}`", path.display())]
    Format {
        /// The clip.
        path: PathBuf,
        /// Why.
        source: Box<mcap::McapError>,
    },
    /// An unfinished clip of a recorder that died cannot be saved. It is left as it is.
    #[error("cannot recover the unfinished clip `{}`", path.display())]
    Recover {
        /// The unfinished clip.
        path: PathBuf,
        /// Why.
        source: Box<RecordError>,
    },
    /// A clip that was found cannot be read.
    #[error("cannot read clip `{}`", path.display())]
    Unreadable {
        /// The clip.
        path: PathBuf,
        /// Why.
        source: Box<ReplayError>,
    },
    /// A topic of a clip that was found cannot be read.
    #[error("cannot read a topic of clip `{}`", path.display())]
    Topic {
        /// The clip.
        path: PathBuf,
        /// Why.
        source: Box<TransportError>,
    },
    /// A file of the preroll cannot be written, read or removed.
    #[error("cannot keep the preroll in `{}`", path.display())]
    Preroll {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// There is no memory for the preroll.
    #[error("there is no memory for a preroll of {} MiB", bytes.div_ceil(1 << 20))]
    PrerollMemory {
        /// What was asked for.
        bytes: u64,
        /// What the system said.
        source: TryReserveError,
    },
    /// A topic says more of itself than a clip has room for.
    #[error("the {what} of topic `{topic}` has {bytes} bytes; a clip has room for {most}")]
    LongTopic {
        /// Its name, or the begin of it.
        topic: String,
        /// What is long.
        what: &'static str,
        /// How long it is.
        bytes: usize,
        /// How long it may be.
        most: usize,
    },
    /// Something is larger than a clip can hold.
    #[error("{what} of {bytes} bytes is larger than clip `{}` can hold: {most} bytes", path.display())]
    TooLarge {
        /// The clip.
        path: PathBuf,
        /// What it is.
        what: &'static str,
        /// How large it is.
        bytes: usize,
        /// How large it may be.
        most: usize,
    },
    /// The thread that writes clips cannot be started, or is not there any more.
    #[error("cannot write clips beside the recording")]
    Thread {
        /// Why.
        source: io::Error,
    },
    /// More topics than a recorder holds.
    #[error("a recorder holds at most {most} topics")]
    TooManyTopics {
        /// How many it holds.
        most: usize,
    },
    /// Topics whose names and types are longer than a recorder holds.
    #[error("the names and types of the recorded topics take more than {} KiB", most >> 10)]
    LongNames {
        /// How many bytes it holds.
        most: usize,
    },
    /// More lambdas than a recorder holds; one that was started again counts again.
    #[error("a recorder holds at most {most} lambdas, counted with each start")]
    TooManyLambdas {
        /// How many it holds.
        most: usize,
    },
}

impl RecordError {
    /// Whether there is no room on the disk.
    pub(crate) fn is_full_disk(&self) -> bool {
        matches!(self.system(), Some(io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded))
    }

    /// What the system said, wherever in the chain of causes it stands.
    fn system(&self) -> Option<io::ErrorKind> {
        self.io().find(|error| error.raw_os_error().is_some()).map(io::Error::kind)
    }

    /// Whether something that is no file or folder of ours has the name of one.
    fn is_in_the_way(&self) -> bool {
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
        let help = match (self, self.system()) {
            (Self::Busy { .. }, _) => "wait until it ends, or choose another folder: --out DIR",
            (Self::TooManyTopics { .. } | Self::LongNames { .. }, _) => {
                "record fewer topics: [record] topics in lambda.toml, or --topics of a replay"
            }
            (Self::PrerollMemory { .. }, _) => {
                "keep less: preroll_size in lambda.toml, or --preroll-memory BYTES"
            }
            (Self::LongTopic { .. }, _) => "remove the topic from [record]",
            (_, Some(io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)) => {
                "make room on the disk, or choose another folder: --out DIR"
            }
            (_, Some(io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem)) => {
                "choose a folder that you may write to: --out DIR"
            }
            _ if self.is_in_the_way() => UnsafePath::HELP,
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
    fn a_full_disk_is_explained_however_deep_it_lies() {
        let write = RecordError::Write { path: "clips/a.mcap.part".into(), source: full() };
        assert_eq!(write.to_string(), "cannot write `clips/a.mcap.part`");
        let format =
            RecordError::Format { path: "a".into(), source: Box::new(mcap::McapError::Io(full())) };
        let recover = RecordError::Recover {
            path: "a".into(),
            source: Box::new(RecordError::Write { path: "b".into(), source: full() }),
        };
        for error in [write, format, recover] {
            assert_eq!(
                error.help().as_deref(),
                Some("make room on the disk, or choose another folder: --out DIR")
            );
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
