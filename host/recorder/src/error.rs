//! Errors of recording, with messages and help for users.

use std::collections::TryReserveError;
use std::error::Error;
use std::io;
use std::path::PathBuf;

use gleaner_base::safe_file::UnsafePath;
use gleaner_base::{Exit, Explain};
use gleaner_drives::ReplayError;
use gleaner_messages::transport::TransportError;

#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error("cannot create `{}`", path.display())]
    Create { path: PathBuf, source: io::Error },
    #[error("cannot lock `{}`", path.display())]
    Lock { path: PathBuf, source: io::Error },
    #[error("another process records into `{}`", folder.display())]
    Busy { folder: PathBuf },
    #[error("cannot read `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("cannot write `{}`", path.display())]
    Write { path: PathBuf, source: io::Error },
    #[error("cannot sync `{}` to disk", path.display())]
    Sync { path: PathBuf, source: io::Error },
    #[error("cannot rename `{}` to `{}`", from.display(), to.display())]
    Rename { from: PathBuf, to: PathBuf, source: io::Error },
    #[error("cannot remove `{}`", path.display())]
    Remove { path: PathBuf, source: io::Error },
    /// A clip is complete, but not in the list of clips; it will be listed when the folder is
    /// opened the next time.
    #[error("cannot list a clip in `{}`", path.display())]
    List { path: PathBuf, source: io::Error },
    #[error("cannot write clip `{}`", path.display())]
    Format { path: PathBuf, source: Box<mcap::McapError> },
    /// An unfinished clip of a recorder that died cannot be recovered. It is left unchanged.
    #[error("cannot recover the unfinished clip `{}`", path.display())]
    Recover { path: PathBuf, source: Box<RecordError> },
    #[error("cannot read clip `{}`", path.display())]
    Unreadable { path: PathBuf, source: Box<ReplayError> },
    #[error("cannot read a topic of clip `{}`", path.display())]
    Topic { path: PathBuf, source: Box<TransportError> },
    #[error("cannot keep the preroll in `{}`", path.display())]
    Preroll { path: PathBuf, source: io::Error },
    #[error("cannot allocate {} MiB for the preroll", bytes.div_ceil(1 << 20))]
    PrerollMemory { bytes: u64, source: TryReserveError },
    #[error("the {what} of topic `{topic}` has {bytes} bytes; a clip has room for {most}")]
    LongTopic {
        /// Its name, or the beginning of it.
        topic: String,
        what: &'static str,
        bytes: usize,
        most: usize,
    },
    #[error(
        "{what} of {bytes} bytes is larger than clip `{}` can hold: {most} bytes",
        path.display()
    )]
    TooLarge { path: PathBuf, what: &'static str, bytes: usize, most: usize },
    #[error("the thread that writes clips failed")]
    Thread { source: io::Error },
    #[error("a recorder holds at most {most} topics")]
    TooManyTopics { most: usize },
    #[error("the names and types of the recorded topics take more than {} KiB", most >> 10)]
    LongNames { most: usize },
    #[error("a recorder holds at most {most} lambdas, counted with each start")]
    TooManyLambdas { most: usize },
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
