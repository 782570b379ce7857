//! The report of `gleaner check`: the result, and the resources that the lambda needs.

use serde::{Deserialize, Serialize};

use gleaner_lambda::manifest::LambdaKind;

/// The result of checking a built lambda without samples: it was loaded, fits the interface, and
/// its `init` returned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CheckReport {
    /// Name of the lambda.
    pub lambda: String,
    /// Version of the lambda.
    pub version: String,
    /// Kind of the lambda.
    pub kind: LambdaKind,
    /// Engine of the lambda, with the version.
    pub engine: String,
    /// Duration of `init`, in ms; `None` if it was not run.
    pub init_ms: Option<f64>,
    /// Resident memory of its process afterwards, including all rings, in bytes.
    pub resident_bytes: u64,
    /// Resources that it needs on a vehicle: preallocated ones, and maxima.
    pub needs: Vec<Need>,
    /// Lines that it logged and printed.
    pub log: Vec<String>,
    /// Notes for the user, which are not errors.
    pub notes: Vec<String>,
}

/// Memory or disk for one purpose.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Need {
    /// Purpose of the memory or disk, for example ``input `imu`, 1,025 slots``.
    pub purpose: String,
    /// Bytes; `None` if the lambda's manifest sets no limit.
    pub bytes: Option<u64>,
    /// Memory or disk.
    pub place: NeedPlace,
    /// True if it is allocated at the start; otherwise `bytes` is a maximum.
    pub preallocated: bool,
}

/// The resource that a [`Need`] refers to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum NeedPlace {
    Memory,
    Disk,
}
