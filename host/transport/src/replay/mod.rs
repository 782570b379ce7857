//! Recorded drives, pulled message by message in log-time order.
//!
//! [`Replay`] opens MCAP files, merges them by log time and gives the next message of a subscribed
//! topic to its sink each time [`Replay::step`] is called. Nothing runs on its own: the caller's
//! loop is the clock.
//!
//! Of a channel's metadata two keys count: `offered_qos_profiles`, which topics are described with,
//! and `gleaner.writer`, the identity of whoever wrote its messages, which clips keep. What else a file
//! holds, metadata records and attachments, is for [`read_extras`].
//!
//! What never happens here: holding a whole file in memory, delivering a chunk whose checksum is
//! wrong, losing a message silently. rosbag2 directories and sqlite3 are not read yet.

mod catalog;
mod chunk;
mod drive;
mod error;
mod extras;
mod file;
mod records;
mod scan;
mod source;
mod summary;
mod track;
mod writers;

pub use drive::{Limits, Progress, Replay, Step};
pub use error::{Damage, ReplayError};
pub use extras::{Attachment, Extras, read_extras};
