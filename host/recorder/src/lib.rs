//! Records the moments around triggers: the preroll, the windows that triggers open, and the clips
//! that are cut from them.
//!
//! - `preroll`: the recent samples and wakes, in memory or on disk, within a bound.
//! - `window`: from triggers to windows, from windows to clips; pure bookkeeping.
//! - `recorder`: both together, sample by sample and wake by wake.
//! - `file`: atomic clip files in MCAP, the clip index, and crash recovery.
//! - `thumbnail`: a small picture of a moment.
//! - `program`: the process that records live, for all lambdas of a vehicle; with the feature
//!   `program`.
//!
//! A recorder of a replay is synchronous and without threads: the recording depends on the stamps
//! of samples and wakes only. A live recorder is the same, except that a thread writes the files.
//! Never here: running a lambda, or deciding what is worth keeping.

mod digest;
mod error;
mod file;
mod preroll;
#[cfg(feature = "program")]
pub mod program;
mod recorder;
mod thumbnail;
mod window;

pub use digest::lambda_digest;
pub use error::RecordError;
pub use file::{
    ClaimMismatch, ClipStatements, EarlierClips, LossList, MESSAGE_MAX, RecordingFolder,
    TopicSchema,
};
pub use recorder::{
    Commanded, LambdaId, LambdaSpec, Recorder, RecorderCounts, Settings, TOPICS_MAX, TopicId, Work,
};
pub use thumbnail::{ObjectBox, is_image, thumbnail, thumbnail_with_boxes};

/// Most lambdas of one recorder, counted with each start, and of one clip: for each a header is
/// kept.
const LAMBDAS_MAX: usize = 1024;
