//! How a recorder works, and what it has done.

use std::path::PathBuf;
use std::time::Duration;

use gleaner_lambda::manifest::Store;
use gleaner_protocol::RecordingCounts;

/// How a recorder works.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where the preroll waits.
    pub store: Store,
    /// Most bytes of the preroll, with 64 bytes or a little more for each sample.
    pub preroll_bytes: u64,
    /// The longest clip; what is longer goes on in a next one.
    pub max_length: Duration,
    /// The folder that clips go to. A preroll on disk is in `preroll` there.
    pub folder: PathBuf,
    /// What stamps are, for example "log time of the drive".
    pub clock: String,
    /// Whether memory for the preroll is taken from the system at once.
    pub prefault: bool,
}

/// A topic of a recorder.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TopicId(pub(super) usize);

/// A lambda of a recorder.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LambdaId(pub(super) usize);

/// What a recorder has done so far.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct RecorderCounts {
    /// What is reported.
    pub recording: RecordingCounts,
    /// Samples older than one that came before them. They are recorded where windows cover them.
    pub out_of_order: u64,
    /// Bytes that the preroll holds.
    pub preroll_bytes: u64,
    /// The most that it held so far.
    pub preroll_highest: u64,
    /// The most that it may hold.
    pub preroll_bound: u64,
    /// Bytes that are on their way to the thread that writes; 0 where there is none.
    pub in_flight: u64,
}

/// What became of a command.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Commanded {
    /// It opened a window.
    Opened,
    /// It ended a window.
    Stopped,
    /// What it was to start is running, or what it was to stop is not, or too much is.
    Ignored,
    /// Nothing is recorded at present.
    DiskSuppressed,
}

/// What is left to do for a recorder that is fed live.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Work {
    /// Nothing.
    Done,
    /// Some, at once.
    More,
    /// Some, once the thread that writes has come further.
    Wait,
}
