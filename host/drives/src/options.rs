//! How a drive is opened, and which part of it is replayed.

use std::path::PathBuf;

#[cfg(feature = "bags")]
use super::unpack::Unpacked;
use gleaner_messages::Sources;

/// How a drive is opened.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// How much memory and disk it may use.
    pub limits: Limits,
    /// Where message definitions are looked for that the files do not carry; nowhere if `None`.
    pub sources: Option<Sources>,
    /// The folder for the content of packed files, which is gone with the replay; the system's for
    /// temporary files if `None`.
    pub unpack_in: Option<PathBuf>,
    /// Packed files whose content is open already, for a process that may not write. Such a
    /// database is still given a name in `unpack_in` while it is opened.
    #[cfg(feature = "bags")]
    pub unpacked: Vec<Unpacked>,
}

/// How much memory and disk a replay may use.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// The largest chunk, in bytes before or after decompression, that is opened, and the largest
    /// message of a database; a larger one is damage. At most 2 GiB.
    pub chunk_bytes: u64,
    /// Bytes of open chunks beyond which no further one is opened ahead of its turn. Chunks that
    /// overlap in time are open together; past this limit their messages may come out of order,
    /// which [`super::Replay::out_of_order`] counts.
    pub open_bytes: u64,
    /// The most bytes of disk that the content of all packed files of a replay may take. One file
    /// may take 200 times its own size or a 64th of this, whichever is more, and never more than
    /// nine tenths of what is free on the disk.
    pub unpacked_bytes: u64,
}

impl Default for Limits {
    /// 256 MiB for a chunk, 512 MiB for all open ones; usual chunks have 1 to 4 MiB. 64 GiB for
    /// what packed files hold, all together.
    fn default() -> Self {
        Self { chunk_bytes: 256 << 20, open_bytes: 512 << 20, unpacked_bytes: 64 << 30 }
    }
}

/// A part of a drive, by log times in ns.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) struct Span {
    pub(super) from: u64,
    /// The first that does not belong to it; `None` if it has no end.
    to: Option<u64>,
}

impl Span {
    pub(super) const ALL: Self = Self { from: 0, to: None };

    /// No message is older than 1970.
    pub(super) fn between(from_ns: i64, to_ns: i64) -> Self {
        let time = |ns| u64::try_from(ns).unwrap_or(0);
        Self { from: time(from_ns), to: (to_ns < i64::MAX).then(|| time(to_ns)) }
    }

    pub(super) fn holds(self, time: u64) -> bool {
        time >= self.from && !self.ends_before(time)
    }

    /// Whether neither `time` nor anything later belongs to it.
    pub(super) fn ends_before(self, time: u64) -> bool {
        self.to.is_some_and(|to| to <= time)
    }

    /// Whether some of the times from `first` to `last` may belong to it.
    pub(super) fn meets(self, first: u64, last: u64) -> bool {
        last >= self.from && !self.ends_before(first)
    }
}
