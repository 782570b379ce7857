//! What Gleaner's programs share, and the only thing they share: the manifest, decisions, journals, clips, reports,
//! exit codes, how an error looks to a user, and where the parts of an installation are found.
//!
//! Nothing here runs a lambda, listens on a socket, or needs more than a few small dependencies, so that the smallest
//! program can afford it. Programs talk to each other through these types; they never link each other.

mod checked;
mod clip;
mod decision;
mod drive_seen;
mod drive_time;
mod exit;
mod exit_record;
mod failure;
mod isolation;
pub mod journal;
pub mod layout;
pub mod link;
mod live;
mod log_line;
pub mod manifest;
mod output;
pub mod own_file;
mod page;
pub mod parts;
mod plain_file;
mod recording;
mod report;
pub mod results;
#[cfg(test)]
mod scratch;
pub mod signals;
mod sources;
mod undecided;
mod vehicle;
mod whole;
mod words;

pub use checked::{Checked, Need, Place};
pub use clip::{Clip, ClipLambda, ClipTopic, Moment, Recovered};
pub use decision::{Cause, Decision, Fault, FaultKind, SCORE_TOLERANCE, Trigger, TriggerKind, twins_differ};
pub use drive_seen::{DriveSeen, Picture, RecordedTopicSeen};
pub use drive_time::{DriveTime, DriveTimeError};
pub use exit::Exit;
pub use exit_record::{Doing, ExitRecord, Killed, UNTIL_KILLED, Why};
pub use failure::{Explain, Failure};
pub use isolation::{Holds, LAYERS_ENV, Layer};
pub use layout::{BuildDir, LayoutError};
pub use live::{Live, LiveTopic, Network, Spread, ToRecorder};
pub use log_line::{LogLevel, LogLine};
pub use manifest::{Manifest, ManifestError};
pub use output::{LOCK, Output, OutputError, RESULTS};
pub use page::{PAGE_BYTES, Page, RESULTS_ENV, WokenBy};
pub use parts::{Looked, Parts, PartsError};
pub use plain_file::{NotPlain, PlainFile};
pub use recording::{Counted, Outcome, Recording};
pub use report::{Report, Round, Summary, TopicReport, TopicSeen, Verified};
pub use sources::{SOURCE_MAX, Sources};
pub use vehicle::Vehicle;
pub use whole::write_whole;
pub use words::{excerpt, grouped, hex, visible};
