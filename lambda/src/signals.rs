//! The values that a replayed lambda read, and the cost of its wakes: `signals.json`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::manifest::ConfigValue;

/// The values that a replayed lambda read, and the cost of its wakes: the file `signals.json`, from
/// which the report is drawn.
///
/// The size of the file is bounded: a curve has up to [`Signals::POINTS_MAX`] points, a lambda up
/// to [`Signals::CURVES_MAX`] curves.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Signals {
    /// The effective configuration, by key.
    pub config: BTreeMap<String, ConfigValue>,
    /// The values of each field that the lambda read, in the order of the first reads.
    pub curves: Vec<Curve>,
    /// Number of fields beyond [`Signals::CURVES_MAX`], which have no curve.
    pub curves_omitted: u64,
    /// Time in the lambda for each wake, in ns.
    pub run_ns: Distribution,
    /// Fuel of each wake; `None` for Python, which has no fuel.
    pub fuel: Option<Distribution>,
    /// Camera pictures at wakes that triggered, evenly chosen: at most [`Signals::PICTURES_MAX`].
    pub pictures: Vec<TriggerPicture>,
    /// Number of wakes that triggered and have no picture, as there were more of them or no image.
    pub pictures_omitted: u64,
}

impl Signals {
    pub const CURVES_MAX: usize = 32;
    pub const POINTS_MAX: usize = 4096;
    pub const PICTURES_MAX: usize = 64;
}

/// One number over time, as a lambda read it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    pub input: String,
    /// Topic of the input, after remapping.
    pub topic: String,
    /// The path of the field, such as `linear_acceleration.x`, or a value that the host computed
    /// from a picture: `mean luma`.
    pub path: String,
    /// Number of samples from which the lambda read it, with rising stamps: of equal ones the
    /// first.
    pub samples: u64,
    /// Number of samples in which it was NaN or infinite: these are in no point.
    pub non_finite: u64,
    pub per_point: u64,
    /// Stamp of the first sample of each point, in ns since the epoch of the drive.
    pub at_ns: Vec<i64>,
    pub min: Vec<f64>,
    pub max: Vec<f64>,
}

/// The distribution of a number per wake, to three digits, rounded down.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Distribution {
    /// Number of wakes with a value.
    pub count: u64,
    pub min: u64,
    pub p50: u64,
    pub p90: u64,
    pub p99: u64,
    pub max: u64,
    /// Histogram, with bins that grow with the value; empty bins are left out.
    pub bins: Vec<Bin>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Bin {
    /// Lower end, inclusive.
    pub from: u64,
    /// Upper end, exclusive.
    pub to: u64,
    /// Number of wakes in it.
    pub count: u64,
}

/// A camera picture at a wake that triggered.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TriggerPicture {
    /// Time of the wake that triggered, in ns since the epoch of the drive.
    pub at_ns: i64,
    pub topic: String,
    /// Stamp of the image, the newest that had arrived.
    pub image_ns: i64,
    /// A small JPEG, relative to the folder that holds `signals.json`, for example
    /// `pictures/trigger-000000.jpg`.
    pub file: PathBuf,
}
