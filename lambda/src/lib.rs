//! The data of a lambda and its results: the manifest with its limits, the build folder, decisions,
//! clips, log lines, and the files of a run.
//!
//! Nothing here runs a lambda.

mod clip;
mod decision;
pub mod layout;
mod log_line;
pub mod manifest;
mod output;
mod output_lock;
pub mod results;
pub mod signals;
mod sources;

pub use clip::{Clip, ClipLambda, ClipTopic, Moment, Recovered};
pub use decision::{
    Cause, Decision, Fault, FaultKind, SCORE_TOLERANCE, Trigger, TriggerKind, twins_differ,
};
pub use layout::{BuildDir, LayoutError};
pub use log_line::{LogLevel, LogLine};
pub use manifest::{
    DeploymentSettings, InferenceLimits, Manifest, ManifestError, MetricsSettings, NetworkSettings,
    RecordingSettings, Vehicle, VehicleIdentity,
};
pub use output::{Output, OutputError, RESULTS};
pub use output_lock::{OutputLock, OutputLockError};
pub use results::RESULT_ITEM_MAX;
pub use sources::{REQUIREMENTS, SOURCE_MAX, Sources};
