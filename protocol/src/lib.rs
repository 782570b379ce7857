//! Messages between Gleaner programs: reports of a runtime, result items, exit records, frames to
//! and from the recorder, the ingress and the process that runs models, and the state of a vehicle.
//!
//! [`process_stats`] makes the reports of a process about itself. Nothing here runs a lambda or
//! listens on a socket. Programs share these types; they never link each other.

#![warn(missing_docs)]

mod check_report;
mod counts;
mod drive_info;
mod drive_time;
mod exit_record;
mod handover;
pub mod inference;
pub mod ingress;
mod interrupted_wake;
mod isolation;
pub mod link;
mod live_status;
mod recording;
mod report;
mod result_item;
mod spooled;
pub mod supervision;
pub mod vehicle_api;
// No messages: what a process knows of itself.
#[allow(missing_docs)]
pub mod process_stats;

pub use check_report::{CheckReport, Need, NeedPlace};
pub use counts::{DurationStats, LinkLosses, NetworkStatus, ReceptionGaps};
pub use drive_info::{DriveInfo, DriveTopicInfo, PictureInfo};
pub use drive_time::{DriveTime, DriveTimeError};
pub use exit_record::{ExitRecord, KillReason, Killed, Phase, SHUTDOWN_TIMEOUT};
pub use handover::{Handover, HandoverReceiver, PASSES_INFERENCE};
pub use isolation::{Holds, LAYERS_ENV, Layer, NEEDED_CALLS, REQUIRED_LAYERS, SHIM_ENV};
pub use live_status::{LiveStatus, LiveTopic, WakeCounts};
pub use recording::{LossCount, LossOutcome, RecordingCounts};
pub use report::{ReplaySummary, Report, Round, TopicReport, Verified};
pub use result_item::{RESULTS_ENV, ResultItem, WokenBy};
pub use spooled::{
    ItemLosses, OmittedRecord, OriginError, ProcessOrigin, ProcessStart, SpooledRecord,
    SpooledRecordError,
};
