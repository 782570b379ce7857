//! Messages between Gleaner's programs: reports of a runtime, pages of results, exit records,
//! frames to and from the recorder.
//!
//! Nothing here runs a lambda or listens on a socket. Programs talk to each other through these
//! types; they never link each other.

mod checked;
mod drive_seen;
mod drive_time;
mod exit_record;
mod isolation;
pub mod link;
mod live;
mod page;
mod recording;
mod report;
#[cfg(test)]
#[path = "../../../base/src/scratch.rs"]
mod scratch;
mod undecided;

pub use checked::{Checked, Need, Place};
pub use drive_seen::{DriveSeen, Picture, RecordedTopicSeen};
pub use drive_time::{DriveTime, DriveTimeError};
pub use exit_record::{Doing, ExitRecord, Killed, UNTIL_KILLED, Why};
pub use isolation::{Holds, LAYERS_ENV, Layer};
pub use live::{Live, LiveTopic, Network, Spread, ToRecorder};
pub use page::{Page, RESULTS_ENV, WokenBy};
pub use recording::{Counted, Outcome, Recording};
pub use report::{Report, Round, Summary, TopicReport, TopicSeen, Verified};
