//! How a recorder works, and what it has done.

use std::path::PathBuf;
use std::time::Duration;

use gleaner_lambda::manifest::Store;

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
pub struct Counts {
    /// Clips that are finished.
    pub clips: u64,
    /// Clips that could not be written, or recovered. What there is of them is recovered when the folder is opened again.
    pub failed: u64,
    /// Clips that were deleted to make room, and that nobody had fetched.
    pub deleted: u64,
    /// Clips that should have been deleted to make room, and could not be.
    pub not_deleted: u64,
    /// Windows that triggers and commands opened.
    pub windows: u64,
    /// Triggers that opened none, because they came within the cooldown of another.
    pub in_cooldown: u64,
    /// Starts while one of the same label was open or 64 of the lambda were, stops while none was, and what came while too many
    /// windows waited for their clip.
    pub ignored: u64,
    /// Triggers but for stops, and commands, that came while nothing was recorded, and windows that waited for their clip then:
    /// [`Recorder::hold`](super::Recorder::hold).
    pub held_back: u64,
    /// Samples that left the preroll for want of bytes before they were too old for any window.
    pub pushed_out: u64,
    /// Samples that are larger than the preroll. While a clip is open, they are in it nevertheless, unless they are larger
    /// than any message of a clip, which is somewhat below 1 GiB.
    pub too_big: u64,
    /// Samples and wakes with a stamp before 1970, and samples of missing topics: they are not recorded.
    pub refused: u64,
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
    HeldBack,
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
