//! Clips on disk: MCAP files that are whole under their name or not there, and the list of them.
//!
//! ```text
//! OUT/clips.jsonl                 a line for each whole clip
//! OUT/clips/.lock                 held by the process that records
//! OUT/clips/NAME.mcap             a whole clip
//! OUT/clips/NAME.jpg              its thumbnail
//! OUT/clips/NAME.mcap.part        a clip that is being written, or whose recorder died
//! OUT/clips/NAME.mcap.part2       what is being saved out of the latter
//! OUT/clips/NAME.jpg.part         a thumbnail that is being written
//! ```
//!
//! A clip is written chunk by chunk, so that a death costs a second of it; then its metadata, attachments and footer;
//! then it is synced and gets its name; then it is listed. [`Folder::open`] finishes what a death interrupted, wherever
//! that was, and a death in the middle of that changes nothing.
//!
//! Never: a file touched that this program did not write; a clip that was acknowledged deleted other than by
//! [`Folder::replace`].

mod durable;
mod ending;
mod folder;
mod list;
mod part;
mod place;
mod read;
mod recover;
mod sink;
#[cfg(test)]
mod tests;
mod unfinished;

use std::collections::BTreeMap;
use std::sync::Arc;

use gleaner_protocol::{ClipLambda, Moment};

pub use folder::Folder;
pub use unfinished::Unfinished;

/// What is known when a clip begins. It stands in front of the messages, so that a recovered clip still says what it is.
#[derive(Clone, Debug, PartialEq)]
pub struct About {
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
pub struct Topic {
    /// Absolute topic name.
    pub name: String,
    /// Message type, as `pkg/msg/Type`.
    pub type_name: String,
    /// ros2msg text of the type and all it refers to; `None` if nobody has it.
    pub definitions: Option<Arc<str>>,
    /// The quality of service that its writers offer, as rosbag2 writes it.
    pub offered_qos: Option<String>,
}

/// What is known when a clip ends.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ending {
    /// Begin of what was asked for, in ns.
    pub from_ns: i64,
    /// End of what was asked for, inclusive, in ns.
    pub to_ns: i64,
    /// The lambdas whose windows it holds.
    pub lambdas: Vec<ClipLambda>,
    /// Triggers within it.
    pub triggers: u64,
    /// These triggers, or as many of them as were kept.
    pub moments: Vec<Moment>,
    /// What is known of its topics. How many messages were written is counted here, not there.
    pub topics: Vec<TopicCounts>,
    /// Why it holds less than was asked for, in words.
    pub short: Vec<String>,
    /// A JPEG.
    pub thumbnail: Option<Vec<u8>>,
    /// For each lambda its part of the journal.
    pub journals: Vec<(String, Vec<u8>)>,
    /// Further metadata records. One named `gleaner.lambda` with a `name` takes the place of the one that
    /// would be made from [`Ending::lambdas`].
    pub metadata: Vec<(String, BTreeMap<String, String>)>,
}

/// What is known of a topic besides its messages in the clip; `None` is unknown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TopicCounts {
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
