//! Recorded drives, pulled message by message in log-time order.
//!
//! [`Replay`] opens MCAP files, databases of rosbag2 (SQLite, `.db3`) and the directories that
//! rosbag2 writes, each packed with zstd or not, merges them by log time and passes the next
//! message of a subscribed topic to its sink each time [`Replay::step`] is called. Nothing runs on
//! its own: the caller's loop is the clock. A [`DrivePlayer`] is such a loop: it plays a drive in
//! real time, as a live source. The first bytes of a file choose its reader
//! (`storage`); after that all files are alike. Directories, databases and packed files need the
//! feature `bags`.
//!
//! Two keys of a channel's metadata are used: `offered_qos_profiles`, for the description of the
//! topic, and `gleaner.writer`, the identity of the writer, which clips contain. The other content
//! of a file, metadata records and attachments, is read by [`read_extras`].
//!
//! No file is held in memory as a whole, no chunk with a wrong checksum is delivered, no message is
//! lost silently, and nothing is written to a drive.

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
mod player;
mod records;
#[cfg(feature = "bags")]
mod rows;
mod scan;
mod separate;
mod source;
mod step;
mod storage;
mod summary;
mod track;
#[cfg(feature = "bags")]
mod unpack;
#[cfg(feature = "bags")]
mod unpacked;
mod writers;

pub use bag::{files_of, journals_of};
pub use damage::{Damage, DamageLocation};
pub use drive::Replay;
pub use error::ReplayError;
pub use extras::{Attachment, Extras, read_extras};
pub use options::{DriveLimits, DriveOptions};
pub use player::DrivePlayer;
pub use step::{Progress, ReplayStep};
#[cfg(feature = "bags")]
pub use unpack::unpack;
#[cfg(feature = "bags")]
pub use unpacked::{ContentName, Unpacked};
