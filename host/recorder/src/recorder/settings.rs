//! Settings and counts of a recorder.

use std::path::PathBuf;
use std::time::Duration;

use gleaner_lambda::manifest::Store;
use gleaner_protocol::RecordingCounts;

#[derive(Clone, Debug)]
pub struct Settings {
    pub store: Store,
    /// Most bytes of the preroll, with 64 bytes or a little more for each sample.
    pub preroll_bytes: u64,
    /// The longest clip; a longer recording continues in the next clip.
    pub max_length: Duration,
    /// The output folder. A preroll on disk is in `preroll` there.
    pub folder: PathBuf,
    /// The clock of stamps, for example "log time of the drive".
    pub clock: String,
    /// True if memory for the preroll is allocated at once.
    pub prefault: bool,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TopicId(pub(super) usize);

#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LambdaId(pub(super) usize);

#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct RecorderCounts {
    pub recording: RecordingCounts,
    /// Samples older than an earlier one. They are recorded if windows cover them.
    pub out_of_order: u64,
    /// Bytes that the preroll holds.
    pub preroll_bytes: u64,
    /// The most bytes that it held so far.
    pub preroll_highest: u64,
    /// The most bytes that it may hold.
    pub preroll_bound: u64,
    /// Bytes queued for the writer thread; 0 if there is none.
    pub in_flight: u64,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Commanded {
    Opened,
    Stopped,
    /// Ignored: the recording to start is running, or the one to stop is not, or too many are.
    Ignored,
    /// Recording is suspended.
    DiskSuppressed,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Work {
    Done,
    /// Some, now.
    More,
    /// Some, once the writer thread has made progress.
    Wait,
}
