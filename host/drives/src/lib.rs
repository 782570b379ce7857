//! Recorded drives, pulled message by message in log-time order.
//!
//! [`Replay`] opens MCAP files, databases of rosbag2 (SQLite, `.db3`) and the directories that
//! rosbag2 writes, each packed with zstd or not, merges them by log time and gives the next message
//! of a subscribed topic to its sink each time [`Replay::step`] is called. Nothing runs on its own:
//! the caller's loop is the clock. Who reads a file is decided by its first bytes; behind that
//! decision (`storage`) all files are alike. Directories, databases and packed files come with the
//! feature `bags`.
//!
//! Of a channel's metadata two keys count: `offered_qos_profiles`, which topics are described with,
//! and `gleaner.writer`, the identity of whoever wrote its messages, which clips keep. What else a
//! file holds, metadata records and attachments, is for [`read_extras`].
//!
//! What never happens here: holding a whole file in memory, delivering a chunk whose checksum is
//! wrong, losing a message silently, writing to a drive.

#[cfg(feature = "bags")]
mod bag;
mod catalog;
mod chunk;
mod damage;
#[cfg(feature = "bags")]
mod database;
mod drive;
mod error;
mod extras;
mod file;
mod indexes;
mod inflate;
#[cfg(feature = "bags")]
mod metadata;
mod options;
mod records;
#[cfg(feature = "bags")]
mod rows;
mod scan;
mod source;
mod step;
mod storage;
mod summary;
mod track;
#[cfg(feature = "bags")]
mod unpack;
mod writers;

pub use damage::{Damage, Place};
pub use drive::Replay;
pub use error::ReplayError;
pub use extras::{Attachment, Extras, read_extras};
pub use options::{Limits, Options};
pub use step::{Progress, Step};
pub use storage::{files_of, journals_of};
#[cfg(feature = "bags")]
pub use unpack::{Name, Unpacked, unpack};
