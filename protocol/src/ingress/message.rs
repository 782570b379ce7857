//! Messages between the ingress and one reader, and reports to the starter.

use std::net::Ipv4Addr;

use serde::{Deserialize, Serialize};

use super::{Health, PinGrant, ReceptionStatus};
use crate::counts::add;

/// A message from the ingress to a reader.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReaderMessage {
    /// The first message. With the descriptor of the reader's control page.
    Welcome,
    /// A granted topic is subscribed. With the descriptor of its memory.
    Attached(Box<AttachedTopic>),
    /// A granted topic cannot be read.
    Refused {
        /// Its id.
        id: u32,
        /// The reason.
        reason: RefusedTopic,
    },
    /// The answer to a request for definitions. `None`: there are none.
    Definitions {
        /// Id of the topic.
        id: u32,
        /// ros2msg text of its type and of all types it refers to.
        text: Option<String>,
    },
    /// The answer to a request for a layout.
    Layout {
        /// Id of the topic.
        id: u32,
        /// Hash (RIHS01) of the layout that is received; `None` if no writer has announced one.
        type_hash: Option<String>,
    },
    /// The state of the source, once a second.
    Status(Box<SourceStatus>),
}

/// A topic in shared memory.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AttachedTopic {
    /// Its id, from the grant.
    pub id: u32,
    /// Its type, as the source spells it.
    pub type_name: String,
    /// Sizes of its memory.
    pub layout: RegionLayout,
    /// First of its hazard words on the control page.
    pub first_word: u32,
    /// Samples that the reader may hold at a time.
    pub holds: PinGrant,
    /// Position of the first sample that this reader receives.
    pub first: u64,
    /// Sum of the digests of all samples before the first one, modulo 2^32.
    #[serde(default)]
    pub digests: u32,
    /// Number of samples refused before the first one.
    #[serde(default)]
    pub refused: u64,
    /// ros2msg text of the type and all types it refers to, if the source carries it.
    pub definitions: Option<String>,
    /// Hash (RIHS01) of the layout that is received, if a writer of the topic has announced one.
    /// Samples have the layout number 1 if their writer announces it, and 0 if it announces none.
    #[serde(default)]
    pub type_hash: Option<String>,
    /// True if the samples are those of a recording: its definitions are preferred to any other.
    #[serde(default)]
    pub is_recorded: bool,
    /// The QoS that the topic's writers offer, as rosbag2 writes it.
    pub offered_qos: Option<String>,
}

/// Sizes of the memory of a topic.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RegionLayout {
    /// Samples that the topic shows at most.
    pub depth: u32,
    /// Slots for samples.
    pub slots: u32,
    /// Bytes of the largest sample.
    pub slot_bytes: u64,
}

/// The reason why a topic cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RefusedTopic {
    /// The source has no topic of this name.
    NoSuchTopic {
        /// The topics of the source, sorted.
        known: Vec<String>,
        /// The most similar name, if one is similar.
        nearest: Option<String>,
    },
    /// The topic carries another type.
    WrongType {
        /// Its type.
        found: String,
    },
    /// Any other reason, as text: the error, then its causes.
    Other(Vec<String>),
}

/// The state of a source and of its granted topics.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SourceStatus {
    /// State of the source.
    pub health: Health,
    /// Id and state of each attached topic.
    pub topics: Vec<(u32, ReceptionStatus)>,
    /// Number of messages of this reader that the source refused to publish.
    #[serde(default)]
    pub unsent: u64,
}

/// A report of the ingress to its starter: a line of JSON on its standard output.
///
/// The key `ingress` has the kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "ingress", rename_all = "snake_case")]
pub enum IngressReport {
    /// It has joined the network, as this participant. Before `Ready`.
    Joined(JoinedParticipant),
    /// It has joined the network, or opened the drive.
    Ready,
    /// Its status, once a second.
    Status(Box<IngressStatus>),
    /// The drive that it plays is over.
    DriveEnded,
    /// It has ended on request. Its last status.
    Ended(Box<IngressStatus>),
    /// The topics of the network, sorted by name: the only report of `gleaner-ingress topics`.
    Topics {
        /// Each topic once.
        topics: Vec<TopicInfo>,
    },
}

/// The multicast group of RTPS for discovery.
pub const DISCOVERY_GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

/// A DDS participant, and where it announces itself: enough to announce its end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JoinedParticipant {
    /// Prefix of its GUIDs.
    pub prefix: [u8; 12],
    /// Port of the multicast group for discovery, which depends on the domain.
    pub port: u16,
    /// Addresses of its interfaces with multicast.
    pub addresses: Vec<Ipv4Addr>,
}

/// A topic of the network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicInfo {
    /// Absolute name.
    pub topic: String,
    /// Message type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Number of writers.
    pub writers: usize,
    /// Number of readers.
    pub readers: usize,
    /// QoS profiles that the writers offer, as text, each once.
    pub qos: Vec<String>,
}

/// The status of the ingress.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct IngressStatus {
    /// State of the source.
    pub health: Health,
    /// Each subscribed topic.
    pub topics: Vec<IngressTopic>,
    /// Number of connected readers.
    pub readers: usize,
    /// Resident memory of this process alone, in bytes: samples in shared memory are not part of
    /// it.
    pub rss_bytes: u64,
    /// CPU time of this process, in s.
    pub cpu_s: f64,
}

/// A topic that the ingress has subscribed.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct IngressTopic {
    /// Its name on the network.
    pub topic: String,
    /// Its type.
    pub type_name: String,
    /// Number of readers.
    pub readers: usize,
    /// Number of samples received.
    pub received: u64,
    /// Number of samples that were larger than a reader accepts.
    pub too_big: u64,
    /// Reserved memory of its regions, in bytes.
    pub reserved_bytes: u64,
    /// State of its subscription.
    pub reception: ReceptionStatus,
}

impl IngressTopic {
    /// Adds the counts that an earlier ingress had for the topic. The number of samples lost
    /// between the two is known to the readers only.
    #[must_use]
    pub fn after(mut self, before: &IngressTopic) -> IngressTopic {
        let sum = |now: Option<u64>, before: Option<u64>| {
            now.zip(before).map(|(now, before)| now.saturating_add(before))
        };
        let (now, earlier) = (&mut self.reception, &before.reception);
        now.lost = None;
        now.before_match = sum(now.before_match, earlier.before_match);
        add([
            (&mut self.received, before.received),
            (&mut self.too_big, before.too_big),
            (&mut now.malformed, earlier.malformed),
        ]);
        self
    }
}
