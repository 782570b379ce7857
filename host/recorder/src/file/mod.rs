//! Clips on disk: atomic MCAP files, and the list of them.
//!
//! ```text
//! OUT/clips.jsonl                 a line for each complete clip
//! OUT/losses.jsonl                a line for each loss
//! OUT/clips/.lock                 held by the process that records
//! OUT/clips/.replaced             clips of an earlier replay that will be deleted
//! OUT/clips/NAME.mcap             a complete clip
//! OUT/clips/NAME.jpg              its thumbnail
//! OUT/clips/NAME.mcap.part        a clip that is being written, or whose recorder died
//! OUT/clips/NAME.mcap.part2       a recovered copy of the latter, in progress
//! OUT/clips/NAME.jpg.part         a thumbnail that is being written
//! ```
//!
//! A clip is written chunk by chunk, so that a crash costs at most a second of it. Then its
//! metadata, attachments and footer are written, it is synced and renamed, and it is listed.
//! `Recovery` completes an interrupted clip at any stage, and a crash during recovery changes
//! nothing; a clip that it cannot complete stays for the next start.
//!
//! The signature of a clip covers its end too, which follows it in the file. So `sink` holds the
//! end until `signing` has completed it, and writes it then: the order of writes stays the same.
//!
//! Nothing here changes a file that this program did not write. Acknowledged clips are deleted only
//! by [`EarlierClips::replace`] and, before they are fetched, by
//! [`RecordingFolder::keep_at_most`].

mod claims;
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
mod signing;
mod sink;
#[cfg(test)]
pub(crate) mod tests;
mod unfinished;
mod written;

use std::sync::Arc;

use gleaner_journal::JournalHeader;
use gleaner_lambda::{ClipLambda, Moment};

pub use claims::{ClaimMismatch, ClipStatements};
pub(crate) use clip_dir::names;
pub(crate) use clip_records::CONTINUES;
pub use folder::{EarlierClips, RecordingFolder};
pub use losses::LossList;
pub use unfinished::MESSAGE_MAX;
pub(crate) use unfinished::UnfinishedClip;

use crate::error::RecordError;

/// Maximum length of a topic's name, and of its type's name, in bytes; ROS 2 allows 255. Both are
/// in a line of the list.
const NAME_MAX: usize = 1 << 10;
/// Maximum size of a topic's definitions and quality of service together, in bytes: every reader of
/// a clip holds them in memory.
const DEFINITIONS_MAX: usize = 8 << 20;

/// The data of a clip that is known when it begins. It is written before the messages, so that a
/// recovered clip still has it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ClipHeader {
    /// The clock of the stamps, for example "log time of the drive".
    pub clock: String,
    /// Begin of the window that opened the clip, in ns.
    pub from_ns: i64,
    /// The lambdas whose windows it contains so far.
    pub lambdas: Vec<ClipLambda>,
    /// The trigger that opened it.
    pub moment: Moment,
}

/// A recorded topic, as a clip describes it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TopicSchema {
    /// Absolute topic name.
    pub name: String,
    /// Message type, as `pkg/msg/Type`.
    pub type_name: String,
    /// ros2msg text of the type and all types that it uses; `None` if it is not available.
    pub definitions: Option<Arc<str>>,
    /// The same for further layouts of the type, from number 1 on.
    pub other_definitions: Vec<Arc<str>>,
    /// The quality of service that its writers offer, as rosbag2 writes it.
    pub offered_qos: Option<String>,
}

impl TopicSchema {
    pub(crate) fn layout(&self, number: u16) -> Option<&Arc<str>> {
        match number.checked_sub(1) {
            None => self.definitions.as_ref(),
            Some(other) => self.other_definitions.get(usize::from(other)),
        }
    }

    /// Checks that a clip has room for the topic's description. The fields of the file allow more,
    /// but every reader of a file holds the descriptions in memory.
    pub(crate) fn check(&self) -> Result<(), RecordError> {
        let texts = self.definitions.iter().chain(&self.other_definitions);
        let definitions: usize = texts.map(|text| text.len()).sum();
        let description = definitions + self.offered_qos.as_deref().map_or(0, str::len);
        let parts = [
            ("name", self.name.len(), NAME_MAX),
            ("type name", self.type_name.len(), NAME_MAX),
            ("definitions and quality of service", description, DEFINITIONS_MAX),
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

/// The data of a clip that is known when it ends.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ClipTrailer {
    /// Begin of the requested time, in ns.
    pub from_ns: i64,
    /// End of the requested time, inclusive, in ns.
    pub to_ns: i64,
    /// The lambdas whose windows it contains.
    pub lambdas: Vec<ClipLambda>,
    /// The journal headers of these lambdas, in the same order; empty if unknown. Two may have one
    /// name: a restarted lambda.
    pub headers: Vec<Arc<JournalHeader>>,
    pub triggers: u64,
    /// These triggers, or as many as were kept.
    pub moments: Vec<Moment>,
    /// Counts of its topics. The number of written messages is counted by the file.
    pub topics: Vec<ClipTopicCounts>,
    /// Reasons why it contains less than was requested.
    pub incomplete: Vec<String>,
    /// A JPEG.
    pub thumbnail: Option<Vec<u8>>,
    /// The part of the journal of each lambda.
    pub journals: Vec<(String, Vec<u8>)>,
}

/// Counts of a topic besides its messages in the clip; `None` is unknown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct ClipTopicCounts {
    /// Absolute topic name.
    pub topic: String,
    /// Message type; `None` if it never appeared.
    pub type_name: Option<String>,
    /// Messages that arrived within the windows of the clip.
    pub received: Option<u64>,
    /// Messages lost before they arrived.
    pub lost: Option<u64>,
    /// Messages that the preroll evicted too early.
    pub overwritten: Option<u64>,
    /// Messages too large for the preroll.
    pub too_big: Option<u64>,
}
