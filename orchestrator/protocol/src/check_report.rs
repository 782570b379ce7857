use serde::{Deserialize, Serialize};

use gleaner_lambda::manifest::LambdaKind;

/// What was found out about a built lambda without any sample: it could be loaded, it fits the
/// interface, and its `init` returned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CheckReport {
    /// Name of the lambda.
    pub lambda: String,
    /// Version of the lambda.
    pub version: String,
    /// What kind of lambda it is.
    pub kind: LambdaKind,
    /// What runs it, with its version.
    pub engine: String,
    /// How long `init` took, in ms; `None` if it was not run.
    pub init_ms: Option<f64>,
    /// Resident memory of its process after that, all its rings included, in bytes.
    pub resident_bytes: u64,
    /// What it will take on a vehicle: what is there from the start, and what it may take at most.
    pub needs: Vec<Need>,
    /// What it logged and printed on the way.
    pub log: Vec<String>,
    /// What a user should know, and is no error.
    pub notes: Vec<String>,
}

/// Memory or disk for one purpose.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Need {
    /// What it is for, for example ``input `imu`, 1,025 slots``.
    pub purpose: String,
    /// Bytes; `None` where nothing of the lambda's own bounds it.
    pub bytes: Option<u64>,
    /// Where.
    pub place: NeedPlace,
    /// Taken from the start; else as much as this at most.
    pub preallocated: bool,
}

/// Where something is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum NeedPlace {
    Memory,
    Disk,
}
