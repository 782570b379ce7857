//! What a replayed lambda read, and what its wakes cost.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::manifest::ConfigValue;

/// What a replayed lambda read, and what its wakes cost: the file `signals.json`, from which a
/// report is drawn.
///
/// Its size is bounded: a curve has [`Signals::POINTS_MAX`] points, a lambda
/// [`Signals::CURVES_MAX`] curves.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Signals {
    /// The configuration that held, by key.
    pub config: BTreeMap<String, ConfigValue>,
    /// What the lambda read of each field, in the order in which it asked first.
    pub curves: Vec<Curve>,
    /// Fields that it looked up beyond [`Signals::CURVES_MAX`]: no curve was kept of them.
    pub curves_omitted: u64,
    /// Time in the lambda for each wake, in ns.
    pub run_ns: Distribution,
    /// Fuel of each wake; none in Python, which has no fuel.
    pub fuel: Option<Distribution>,
    /// What a camera saw at wakes that triggered: [`Signals::PICTURES_MAX`] at most, spread over
    /// all of them.
    pub pictures: Vec<TriggerPicture>,
    /// Wakes that triggered and have no picture, since there were more of them, or no image.
    pub pictures_omitted: u64,
}

impl Signals {
    /// Most curves of one lambda.
    pub const CURVES_MAX: usize = 32;
    /// Most points of one curve.
    pub const POINTS_MAX: usize = 4096;
    /// Most pictures.
    pub const PICTURES_MAX: usize = 64;
}

/// One number over time, as a lambda read it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// Name of the input.
    pub input: String,
    /// Its topic, after remapping.
    pub topic: String,
    /// The path of the field, such as `linear_acceleration.x`, or what the host worked out of a
    /// picture: `mean luma`.
    pub path: String,
    /// Samples that it was read of, with stamps that rise: of equal ones the first. Those between
    /// them were not looked at.
    pub samples: u64,
    /// Samples in which it was NaN or infinite: these are in no point.
    pub non_finite: u64,
    /// Samples summed up in one point.
    pub per_point: u64,
    /// Stamp of the first sample of each point, in ns since the epoch of the drive.
    pub at_ns: Vec<i64>,
    /// Least value in each point.
    pub min: Vec<f64>,
    /// Greatest value in each point.
    pub max: Vec<f64>,
}

/// How a number of each wake is spread, to three digits, rounded down.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Distribution {
    /// Wakes that had it.
    pub count: u64,
    /// Least.
    pub min: u64,
    /// Half of the wakes had no more.
    pub p50: u64,
    /// 90 % of the wakes had no more.
    pub p90: u64,
    /// 99 % of the wakes had no more.
    pub p99: u64,
    /// Greatest.
    pub max: u64,
    /// Counts, in bins that grow with the value; empty bins are left out.
    pub bins: Vec<Bin>,
}

/// Wakes whose number lies from `from` up to, and without, `to`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Bin {
    /// Lower end, inclusive.
    pub from: u64,
    /// Upper end, exclusive.
    pub to: u64,
    /// Wakes.
    pub count: u64,
}

/// What a camera saw when a lambda triggered.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TriggerPicture {
    /// Time of the wake that triggered, in ns since the epoch of the drive.
    pub at_ns: i64,
    /// Topic of the camera.
    pub topic: String,
    /// Stamp of the image: the newest that had arrived.
    pub image_ns: i64,
    /// A small JPEG, relative to the folder that holds `signals.json`, for example
    /// `pictures/trigger-000000.jpg`.
    pub file: PathBuf,
}
