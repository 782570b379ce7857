//! Keeps the moments around triggers: the preroll, the windows that triggers open, and the clips
//! that are cut there.
//!
//! - `preroll`: what came lately, in memory or on disk, within a bound.
//! - `window`: from triggers to windows, from windows to clips; pure bookkeeping.
//! - `recorder`: the two together, sample by sample and wake by wake.
//! - `file`: clips as MCAP files that are whole or not there, the list of them, and what a death
//!   leaves.
//! - `thumbnail`: a small picture of a moment.
//! - `program`: the process that does it live, for all lambdas of a vehicle; with the feature of
//!   that name.
//!
//! A recorder of a replay is synchronous and without threads: what is recorded depends on the
//! stamps of samples and wakes only. One that is fed live is the same, but for a thread that writes
//! the files. What never happens here: running a lambda, deciding what is worth keeping.

// The tests within the crate share support with those outside of it.
#[cfg(test)]
extern crate self as gleaner_recorder;

mod digest;
mod error;
mod file;
mod preroll;
#[cfg(feature = "program")]
pub mod program;
mod recorder;
#[cfg(test)]
#[path = "../tests/suite/support/mod.rs"]
mod support;
mod thumbnail;
mod window;

pub use digest::lambda_digest;
pub use error::RecordError;
pub use file::{
    ClipStatements, EarlierClips, FalseStatement, LossList, MESSAGE_MAX, RecordingFolder,
    TopicSchema,
};
pub use recorder::{
    Commanded, LambdaId, LambdaSpec, Recorder, RecorderCounts, Settings, TOPICS_MAX, TopicId, Work,
};
pub use thumbnail::{is_image, thumbnail};

/// Most lambdas of one recorder, counted with each start, and of one clip: of each a header is
/// kept.
const LAMBDAS_MAX: usize = 1024;
