//! The content of a recorded drive, as `gleaner inspect` shows it.

use serde::{Deserialize, Serialize};

use crate::counts::DurationStats;

/// The content of a recorded drive.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DriveInfo {
    /// Log time of its first message, in ns since the epoch; `None` if there is none.
    pub start_ns: Option<i64>,
    /// Log time of its last message, in ns since the epoch.
    pub end_ns: Option<i64>,
    /// The parts of it that were read, as log times in ns, the second exclusive. Empty if all of it
    /// was read.
    pub parts: Vec<[i64; 2]>,
    /// Number of messages after one with a later log time.
    pub out_of_order: u64,
    /// The damage that ended reading, if any.
    pub damaged: Option<String>,
    /// Topics of the drive, sorted by name.
    pub topics: Vec<DriveTopicInfo>,
    /// Number of further topics, which were not read.
    #[serde(default)]
    pub skipped: u64,
}

/// A topic of a drive.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DriveTopicInfo {
    /// Absolute name.
    pub topic: String,
    /// Message type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Number of messages; `None` if the drive does not state it.
    pub messages: Option<u64>,
    /// True if the drive contains the definition of the type, or it is bundled.
    pub is_defined: bool,
    /// Number of layouts by which the drive defines the type; 0 if it does not.
    #[serde(default)]
    pub layouts: u64,
    /// Number of messages that were left out: they are no plain CDR, or have no possible time.
    #[serde(default)]
    pub malformed: u64,
    /// The reason why it cannot be read, if any.
    pub unreadable: Option<String>,
    /// Number of messages in the parts that were read.
    pub messages_read: u64,
    /// Time between consecutive messages there, by log time.
    pub interval: Option<DurationStats>,
    /// Log time of the message before the longest interval, in ns since the epoch.
    pub longest_gap_at_ns: Option<i64>,
    /// Number of gaps in the sequence numbers; `None` if the recorder did not number messages one
    /// by one.
    pub missing: Option<u64>,
    /// Size of the largest message there, as CDR, in bytes.
    pub largest_bytes: u64,
    /// Size of all messages there, in bytes.
    pub bytes: u64,
    /// Format of the first image, for example `jpeg 1280x720` or `bgr8 320x180`; `None` for other
    /// types.
    pub picture: Option<PictureInfo>,
}

/// The format of an image.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PictureInfo {
    /// Name of its encoding.
    pub encoding: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// True if it has to be decoded.
    pub is_compressed: bool,
}
