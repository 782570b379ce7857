//! Clips on disk: MCAP files that are whole under their name or not there, and the list of them.
//!
//! ```text
//! OUT/clips.jsonl                 a line for each whole clip
//! OUT/losses.jsonl                a line for each thing that was wanted and is not there
//! OUT/clips/.lock                 held by the process that records
//! OUT/clips/.replaced             clips of an earlier replay that are about to be deleted
//! OUT/clips/NAME.mcap             a whole clip
//! OUT/clips/NAME.jpg              its thumbnail
//! OUT/clips/NAME.mcap.part        a clip that is being written, or whose recorder died
//! OUT/clips/NAME.mcap.part2       what is being saved out of the latter
//! OUT/clips/NAME.jpg.part         a thumbnail that is being written
//! ```
//!
//! A clip is written chunk by chunk, so that a death costs a second of it; then its metadata,
//! attachments and footer; then it is synced and gets its name; then it is listed. `Recovery`
//! finishes what a death interrupted, wherever that was, and a death in the middle of that changes
//! nothing; what it cannot finish stays for the next start.
//!
//! Never: a file touched that this program did not write; a clip that was acknowledged deleted
//! other than by [`EarlierClips::replace`], or that nobody fetched other than by
//! [`RecordingFolder::keep_at_most`].

mod clip_dir;
mod clip_records;
mod durable;
mod folder;
mod list;
mod losses;
mod origin;
mod read;
mod recover;
mod replaced;
mod retention;
mod sink;
mod stated;
#[cfg(test)]
mod tests;
mod unfinished;
mod written;

use std::sync::Arc;

use gleaner_journal::JournalHeader;
use gleaner_lambda::{ClipLambda, Moment};

pub(crate) use clip_dir::names;
pub(crate) use clip_records::CONTINUES;
pub use folder::{EarlierClips, RecordingFolder};
pub use losses::LossList;
pub(crate) use recover::Recovery;
pub use stated::{ClipStatements, FalseStatement};
pub use unfinished::MESSAGE_MAX;
pub(crate) use unfinished::UnfinishedClip;

use crate::error::RecordError;

/// Most bytes of a topic's name, and of its type's; ROS 2 allows 255. Both stand in a line of the
/// list.
const NAME_MAX: usize = 1 << 10;
/// Most bytes of a topic's definitions and quality of service together: whoever reads a clip has to
/// hold them.
const DEFINITIONS_MAX: usize = 8 << 20;

/// What is known when a clip begins. It stands in front of the messages, so that a recovered clip
/// still says what it is.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ClipHeader {
    /// What the stamps are, for example "log time of the drive".
    pub clock: String,
    /// Begin of the window that opened the clip, in ns.
    pub from_ns: i64,
    /// The lambdas whose windows it holds so far.
    pub lambdas: Vec<ClipLambda>,
    /// The trigger that opened it.
    pub moment: Moment,
}

/// A topic that is recorded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicSchema {
    /// Absolute topic name.
    pub name: String,
    /// Message type, as `pkg/msg/Type`.
    pub type_name: String,
    /// ros2msg text of the type and all it refers to; `None` if nobody has it.
    pub definitions: Option<Arc<str>>,
    /// The quality of service that its writers offer, as rosbag2 writes it.
    pub offered_qos: Option<String>,
}

impl TopicSchema {
    /// Whether a clip has room for what a topic says of itself. The fields of the file are larger;
    /// but what a file says of its topics is held by all who read it.
    pub(crate) fn check(&self) -> Result<(), RecordError> {
        let definitions = self.definitions.as_deref().map_or(0, str::len);
        let clip_header = definitions + self.offered_qos.as_deref().map_or(0, str::len);
        let parts = [
            ("name", self.name.len(), NAME_MAX),
            ("type name", self.type_name.len(), NAME_MAX),
            ("definitions and quality of service", clip_header, DEFINITIONS_MAX),
        ];
        match parts.into_iter().find(|(_, bytes, most)| bytes > most) {
            None => Ok(()),
            Some((what, bytes, most)) => {
                let topic = self.name.chars().take(100).collect();
                Err(RecordError::LongTopic { topic, what, bytes, most })
            }
        }
    }
}

/// What is known when a clip ends.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ClipTrailer {
    /// Begin of what was asked for, in ns.
    pub from_ns: i64,
    /// End of what was asked for, inclusive, in ns.
    pub to_ns: i64,
    /// The lambdas whose windows it holds.
    pub lambdas: Vec<ClipLambda>,
    /// What the journals of these lambdas say of them, in the same order; empty where nobody knows.
    /// Two of them may have one name: a lambda that was started again.
    pub headers: Vec<Arc<JournalHeader>>,
    /// Triggers within it.
    pub triggers: u64,
    /// These triggers, or as many of them as were kept.
    pub moments: Vec<Moment>,
    /// What is known of its topics. How many messages were written is counted here, not there.
    pub topics: Vec<TopicCounts>,
    /// Why it holds less than was asked for, in words.
    pub incomplete: Vec<String>,
    /// A JPEG.
    pub thumbnail: Option<Vec<u8>>,
    /// For each lambda its part of the journal.
    pub journals: Vec<(String, Vec<u8>)>,
}

/// What is known of a topic besides its messages in the clip; `None` is unknown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct TopicCounts {
    /// Absolute topic name.
    pub topic: String,
    /// Message type; `None` if it never appeared.
    pub type_name: Option<String>,
    /// Messages that arrived within the windows of the clip.
    pub received: Option<u64>,
    /// Messages lost before they arrived.
    pub lost: Option<u64>,
    /// Messages that the preroll gave up too early.
    pub overwritten: Option<u64>,
    /// Messages too large for the preroll.
    pub too_big: Option<u64>,
}
