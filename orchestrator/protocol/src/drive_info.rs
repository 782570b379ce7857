use serde::{Deserialize, Serialize};

use crate::DurationStats;

/// What is in a recorded drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DriveInfo {
    /// Log time of its first message, in ns since the epoch; `None` if there is none.
    pub start_ns: Option<i64>,
    /// Log time of its last message, in ns since the epoch.
    pub end_ns: Option<i64>,
    /// What of it was read: log times in ns, the second no longer of the part. All of it if there
    /// are none.
    pub parts: Vec<[i64; 2]>,
    /// Messages that came after one with a later log time.
    pub out_of_order: u64,
    /// Why it was not read to its end, if it is damaged.
    pub damaged: Option<String>,
    /// By name.
    pub topics: Vec<DriveTopicInfo>,
    /// Topics beyond those, which were not looked at.
    #[serde(default)]
    pub skipped: u64,
}

/// A topic of a drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DriveTopicInfo {
    /// Its absolute name.
    pub topic: String,
    /// Its type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// How many messages there are; `None` if nothing says.
    pub messages: Option<u64>,
    /// Whether the drive carries the definitions of the type, or they are known here.
    pub is_defined: bool,
    /// Why it cannot be read, if it cannot.
    pub unreadable: Option<String>,
    /// Messages in what was read of the drive.
    pub messages_read: u64,
    /// Time between neighbours there, by log time.
    pub interval: Option<DurationStats>,
    /// Log time of the message before the longest of these times, in ns since the epoch.
    pub longest_gap_at_ns: Option<i64>,
    /// Numbers that are missing between those of its messages; `None` where the recorder did not
    /// number them one by one.
    pub missing: Option<u64>,
    /// Bytes of the largest message there, as CDR.
    pub largest_bytes: u64,
    /// Bytes of all messages there.
    pub bytes: u64,
    /// Of a topic with pictures: the first one, for example `jpeg 1280x720` or `bgr8 320x180`.
    pub picture: Option<PictureInfo>,
}

/// The shape of a picture.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PictureInfo {
    /// Its encoding in words.
    pub encoding: String,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Whether it has to be decoded.
    pub is_compressed: bool,
}
