//! Options of opening a drive, and the part of it to replay.

use std::path::PathBuf;

#[cfg(feature = "bags")]
use crate::unpacked::Unpacked;
use gleaner_messages::Sources;

#[derive(Clone, Debug, Default)]
pub struct DriveOptions {
    pub limits: DriveLimits,
    /// Sources of message definitions that the files do not carry; `None` for no search.
    pub sources: Option<Sources>,
    /// Merge all files by time into one drive, whatever they contain. Without it, files that are
    /// separate drives are refused, and so are two recordings of one topic at the same time.
    pub merge: bool,
    /// The folder for the content of packed files, which is removed with the replay; `None` for the
    /// system's folder for temporary files.
    pub unpack_in: Option<PathBuf>,
    /// Packed files whose content is already open, for a process that may not write. Such a
    /// database still gets a name in `unpack_in` while it is opened.
    #[cfg(feature = "bags")]
    pub unpacked: Vec<Unpacked>,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct DriveLimits {
    /// Largest chunk, in bytes before or after decompression, and largest message of a database; a
    /// larger one is damage. At most 2 GiB.
    pub chunk_bytes: u64,
    /// Bytes of open chunks beyond which no further one is opened ahead of its turn. Chunks that
    /// overlap in time are open together; past this limit their messages may come out of order,
    /// which [`crate::Replay::out_of_order`] counts.
    pub open_bytes: u64,
    /// Disk space for the content of all packed files of a replay, in bytes. One file may take 200
    /// times its own size or a 64th of this, whichever is more, and never more than nine tenths of
    /// the free disk space.
    pub unpacked_bytes: u64,
}

impl Default for DriveLimits {
    /// Allows 256 MiB for a chunk, 512 MiB for all open ones; usual chunks have 1 to 4 MiB. 64 GiB
    /// for the content of all packed files.
    fn default() -> Self {
        Self { chunk_bytes: 256 << 20, open_bytes: 512 << 20, unpacked_bytes: 64 << 30 }
    }
}

/// A part of a drive, by log times in ns.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) struct Span {
    pub(super) from: u64,
    /// The first time after it; `None` without an end.
    to: Option<u64>,
}

impl Span {
    pub(super) const ALL: Self = Self { from: 0, to: None };

    /// Returns the span from `from_ns` to before `to_ns`. No message is older than 1970.
    pub(super) fn between(from_ns: i64, to_ns: i64) -> Self {
        let time = |ns| u64::try_from(ns).unwrap_or(0);
        Self { from: time(from_ns), to: (to_ns < i64::MAX).then(|| time(to_ns)) }
    }

    pub(super) fn holds(self, time: u64) -> bool {
        time >= self.from && !self.ends_before(time)
    }

    /// Returns whether `time` and everything later are after it.
    pub(super) fn ends_before(self, time: u64) -> bool {
        self.to.is_some_and(|to| to <= time)
    }

    /// Returns whether some of the times from `first` to `last` may be in it.
    pub(super) fn meets(self, first: u64, last: u64) -> bool {
        last >= self.from && !self.ends_before(first)
    }
}
