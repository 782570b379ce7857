//! Topics that a starter grants to a reader of the ingress.

use serde::{Deserialize, Serialize};

use super::Qos;

/// A reader, as its starter announces it to the ingress. Its socket comes with the message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddReader {
    /// Name for messages, and for [`AddTopics`]: unique among the readers of this time.
    pub name: String,
    /// Topics that it may read.
    pub topics: Vec<TopicGrant>,
    /// Topics that it may publish.
    pub publishes: Vec<PublishGrant>,
}

/// Further topics for a reader.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddTopics {
    /// Name of the reader.
    pub reader: String,
    /// Topics that it may read, too.
    pub topics: Vec<TopicGrant>,
}

/// A topic that a reader may publish.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishGrant {
    /// Topic name on the network.
    pub topic: String,
    /// Message type.
    pub type_name: String,
    /// Number of newest messages that the network keeps for its slow readers.
    pub depth: usize,
    /// Size of the largest message, in bytes of CDR; larger ones are counted as unsent.
    pub max_bytes: usize,
}

/// A topic that a reader may read.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicGrant {
    /// Identifies the topic in messages to this reader: for a lambda, the index of its input.
    pub id: u32,
    /// Topic name on the network.
    pub topic: String,
    /// Message type; `None`: the type with most writers, once there is one.
    pub type_name: Option<String>,
    /// QoS to request.
    pub qos: Qos,
    /// Number of samples that the network may queue before the ingress takes them.
    pub queue: usize,
    /// Size of the largest sample that the reader accepts, in bytes of CDR; `None`: the usual
    /// largest size of its type.
    pub max_bytes: Option<u64>,
    /// Number of newest samples that the reader can find.
    pub depth: u32,
    /// Samples that it may hold at a time.
    pub holds: PinGrant,
    /// True if each sample wakes the reader.
    pub wakes: bool,
    /// True if the reader needs the digests of samples, for a journal.
    pub digests: bool,
    /// True if the reader begins with the oldest sample that the memory of the topic shows, and
    /// not with the next one.
    pub shown: bool,
}

/// Samples of one topic that a reader may hold at a time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PinGrant {
    /// Number of windows: samples at neighbouring positions.
    pub windows: u16,
    /// Largest number of samples in a window.
    pub window: u16,
    /// Number of single samples.
    pub singles: u16,
}
