//! The trait that every source of samples implements, with its arguments and results.

use std::fmt;
use std::sync::Arc;

use crate::{Definitions, Endian, MessageError, SourcesError, type_description};
use gleaner_base::text::hint;
use gleaner_protocol::ingress::{Qos, ReceptionStatus};

/// A topic that a caller wants to receive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicSpec {
    /// Absolute topic name, for example `/imu/data`.
    pub topic: String,
    /// Message type, `pkg/msg/Type` or `pkg/Type`; the two spellings are equal.
    pub type_name: String,
    /// Number of samples that a live transport may queue before it drops the oldest. A replay is
    /// pulled and queues none.
    pub queue: usize,
    /// The largest sample that the sink will take, in bytes of CDR. A live transport sizes its
    /// buffers by it; the sink alone decides and returns [`Delivery::TooBig`]. A larger compressed
    /// sample is not unpacked to its end, and not passed to the sink: [`Sink::too_big`] reports it.
    pub max_bytes: usize,
    /// The QoS that a live transport requests.
    pub qos: Qos,
}

/// The identity of a writer: 16 bytes, equal for all of its samples.
#[derive(Copy, Clone, PartialEq, Eq, Hash, Debug, Default, PartialOrd, Ord)]
pub struct Guid(pub [u8; 16]);

impl Guid {
    /// Parses the form that [`fmt::Display`] prints: exactly 32 lower-case hex digits.
    pub fn from_hex(text: &str) -> Option<Self> {
        let digit = |byte: u8| match byte {
            b'0'..=b'9' => Some(byte - b'0'),
            b'a'..=b'f' => Some(byte - b'a' + 10),
            _ => None,
        };
        let (pairs, []) = text.as_bytes().as_chunks::<2>() else { return None };
        let pairs: &[[u8; 2]; 16] = pairs.try_into().ok()?;
        let mut bytes = [0; 16];
        for (byte, [high, low]) in bytes.iter_mut().zip(pairs) {
            *byte = digit(*high)? << 4 | digit(*low)?;
        }
        Some(Self(bytes))
    }
}

impl fmt::Display for Guid {
    /// 32 lower-case hex digits.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", u128::from_be_bytes(self.0))
    }
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct SampleMeta {
    /// Time by the clock that orders all samples, in ns. Replay: log time. Live: receive time.
    pub at_ns: i64,
    /// Time of publication, in ns of the writer's clock.
    pub publish_ns: i64,
    pub writer: Guid,
    /// Sequence number: strictly increasing for each writer, at least 1. A gap is a loss before
    /// this transport.
    pub seq: u64,
    pub endian: Endian,
    /// Bytes 2 and 3 of the encapsulation header, nearly always zeros. Unused, but with them a
    /// recorder can write the original message byte for byte.
    pub options: [u8; 2],
    /// Number of its layout among those of its topic: that of [`Definitions::layouts`]. Live, it is
    /// [`Self::ANNOUNCED`] if the writer announces one, else 0.
    pub layout: u16,
    /// True for a sample from before a clip that was still valid at its begin, which is then its
    /// time: that of a topic with durability transient local.
    pub is_latched: bool,
}

impl SampleMeta {
    /// Number of the layout of live samples whose writers announce one.
    pub const ANNOUNCED: u16 = 1;

    /// Metadata of a little-endian sample in the first layout of its topic, published at `at_ns`,
    /// in ns. Other fields are set with `..`.
    pub fn new(at_ns: i64, writer: Guid, seq: u64) -> SampleMeta {
        SampleMeta {
            at_ns,
            publish_ns: at_ns,
            writer,
            seq,
            endian: Endian::Little,
            options: [0; 2],
            layout: 0,
            is_latched: false,
        }
    }
}

#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Delivery {
    /// Copied and kept.
    Taken,
    /// Dropped: no free slot.
    NoSlot,
    /// Dropped: larger than the sink's limit.
    TooBig,
    /// Left out before the sink: no CDR, or without a time that exists.
    Malformed,
}

/// Takes samples of one topic.
pub trait Sink: Send + Sync {
    /// Takes one sample; `cdr` is the payload without the four bytes of encapsulation.
    ///
    /// Runs on the transport's thread: one copy, no lock that a lambda can hold, never blocks.
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery;

    /// Reports a sample that was skipped, since it is larger than [`TopicSpec::max_bytes`]: it has
    /// at least `len` bytes of CDR. Its result is [`Delivery::TooBig`]; a sink that counts refusals
    /// counts it here.
    fn too_big(&self, _meta: &SampleMeta, _len: usize) {}

    /// Copies a sample whose metadata the transport does not know yet. Returns `None`, as by
    /// default, if the sink needs both at once: then the transport makes its own copy for
    /// [`deliver`](Self::deliver).
    ///
    /// It may run under a lock of the transport, so it only copies memory.
    fn copy(&self, _cdr: &[u8]) -> Option<Delivery> {
        None
    }

    /// Accepts the last [`copy`](Self::copy), taken or refused, as this sample. A copy that is
    /// never accepted is replaced by the next.
    fn accept(&self, _meta: &SampleMeta) {}
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DiscoveredTopic {
    /// Absolute topic name.
    pub topic: String,
    /// Message type as the source spells it.
    pub type_name: String,
    /// ros2msg text of the type and all types it refers to, if the source carries it.
    pub definitions_text: Option<Arc<str>>,
    /// The same for further layouts of the type that the source carries, from number 1 on.
    pub other_definitions: Vec<Arc<str>>,
    /// Hash (RIHS01) of the layout that is received, if the writers announce one.
    pub type_hash: Option<String>,
    /// Number of messages in the source, if known.
    pub messages: Option<u64>,
    /// The QoS that the topic's writers offered, as rosbag2 writes it: YAML under the key
    /// `offered_qos_profiles`, at most 64 KiB. `None` if the source does not carry it.
    pub offered_qos: Option<String>,
}

/// Identifies one successful [`Transport::subscribe`]: 0 for the first of a transport, then
/// counting up.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Subscription(pub usize);

/// A source of samples. Object safe and synchronous.
pub trait Transport {
    /// Returns the topics known now, sorted by name. A live transport may discover more later. Of
    /// several types of a topic, the one with the most writers comes first.
    fn topics(&self) -> Vec<DiscoveredTopic>;

    /// Sends each further sample of a topic to `sink`. A topic may be subscribed several times;
    /// every subscription gets every sample, in the order of subscribing.
    ///
    /// # Errors
    ///
    /// [`TransportError`] if the topic does not exist, has another type or an unsupported encoding,
    /// or if the transport can take no more subscriptions.
    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError>;

    /// Returns the parsed message definitions of a topic in all of its layouts, shared by all
    /// callers; of a topic with several types, those of the subscribed one.
    ///
    /// # Errors
    ///
    /// [`TransportError`] if there is no such topic, or its definitions are missing or malformed.
    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError>;

    /// Returns whether the definitions of a type that has none may become available soon. A live
    /// transport then queries the nodes that write the type, which takes some seconds at most.
    fn search_definitions(&self, _type_name: &str) -> DefinitionsSearch {
        DefinitionsSearch::Ended
    }

    fn status(&self, _subscription: Subscription) -> ReceptionStatus {
        ReceptionStatus::default()
    }
}

/// State of the search for the definitions of a type.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum DefinitionsSearch {
    /// This call has sent a query.
    Started,
    /// Definitions may come: by a query, this one or another, or as the writer is discovered.
    Waiting,
    /// None will come.
    Ended,
}

#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    #[error("no topic `{topic}`{}; there are: {}", hint(nearest), list(known))]
    NoSuchTopic {
        topic: String,
        /// The topics of the source, sorted.
        known: Vec<String>,
        /// The most similar name, if one is similar.
        nearest: Option<String>,
    },
    #[error("topic `{topic}` has type `{found}`, not `{wanted}`")]
    WrongType { topic: String, wanted: String, found: String },
    #[error("topic `{topic}` has {what} `{found}`; only `{wanted}` can be read")]
    Encoding {
        topic: String,
        /// The encoding that is meant: "message encoding" or "schema encoding".
        what: &'static str,
        found: String,
        wanted: &'static str,
    },
    #[error("topic `{topic}` has no message definitions for its type `{type_name}`")]
    NoDefinitions { topic: String, type_name: String },
    #[error("the message definitions of topic `{topic}` cannot be used")]
    BadDefinitions { topic: String, source: MessageError },
    /// The source does not carry definitions, and those that were found elsewhere are invalid.
    #[error("the message definitions of topic `{topic}` cannot be used")]
    UnusableDefinitions { topic: String, source: Box<SourcesError> },
    #[error("the layout of some messages of topic `{topic}` is unknown: {why}")]
    UnknownLayout { topic: String, why: &'static str },
    #[error("topic `{topic}` was subscribed after the replay started")]
    AlreadyStarted { topic: String },
}

/// Maximum number of topics named in an error.
const NAMED: usize = 20;

fn list(names: &[String]) -> String {
    match names.split_at_checked(NAMED) {
        _ if names.is_empty() => "none".to_owned(),
        Some((first, rest)) if !rest.is_empty() => {
            format!("{}, and {} more", first.join(", "), rest.len())
        }
        _ => names.join(", "),
    }
}

/// Chooses the definitions of a live topic: `local` ones, if they have the hash that its writers
/// announce, or if they announce none; otherwise those that the source `carried` from its nodes.
pub fn live_definitions<T: AsRef<str>>(
    type_name: &str,
    type_hash: Option<&str>,
    local: Option<T>,
    carried: Option<T>,
) -> Option<T> {
    let fits = |text: &T| {
        let own = || type_description::type_hash(type_name, text.as_ref());
        type_hash.is_none_or(|announced| own().is_ok_and(|own| own == announced))
    };
    local.filter(fits).or(carried)
}

/// Returns whether two message type names mean the same type: `pkg/msg/Type` equals `pkg/Type`.
pub fn same_type(a: &str, b: &str) -> bool {
    crate::short_name(a) == crate::short_name(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_guid_prints_as_32_hex_digits() {
        let mut bytes = [0; 16];
        bytes[..4].copy_from_slice(b"mcap");
        assert_eq!(Guid(bytes).to_string(), "6d636170000000000000000000000000");
    }

    #[test]
    fn a_guid_is_read_back_from_exactly_what_it_prints() {
        let guid = Guid(std::array::from_fn(|n| (n * 17) as u8));
        let text = guid.to_string();
        assert_eq!(Guid::from_hex(&text), Some(guid));
        for wrong in [
            "",
            &text[1..],
            &format!("{text}0"),
            &text.to_uppercase(),
            &text.replace('0', "+"),
            &"é".repeat(16),
        ] {
            assert_eq!(Guid::from_hex(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn both_spellings_of_a_type_are_equal() {
        assert!(same_type("sensor_msgs/msg/Imu", "sensor_msgs/Imu"));
        assert!(!same_type("sensor_msgs/msg/Imu", "sensor_msgs/msg/Image"));
    }

    #[test]
    fn local_definitions_are_used_only_with_the_announced_hash() {
        // Published by ROS 2 for `std_msgs/msg/String`.
        let hash = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
        let choose = |hash, local, carried| {
            live_definitions("std_msgs/msg/String", hash, Some(local), carried)
        };
        let (right, stale) = ("# a text\nstring data", "string data\nint8 more");
        assert_eq!(choose(Some(hash), right, Some("node's")), Some(right));
        assert_eq!(choose(Some(hash), stale, Some("node's")), Some("node's"));
        assert_eq!(choose(Some(hash), stale, None), None);
        assert_eq!(choose(None, stale, Some("node's")), Some(stale));
    }

    #[test]
    fn the_error_for_a_missing_topic_names_some_of_many() {
        let known = (0..1000).map(|n| format!("/t{n:03}")).collect();
        let error = TransportError::NoSuchTopic { topic: "/imu".to_owned(), known, nearest: None }
            .to_string();
        assert!(error.starts_with("no topic `/imu`; there are: /t000, /t001, "), "{error}");
        assert!(error.ends_with(", /t019, and 980 more"), "{error}");
    }

    #[test]
    fn a_missing_topic_is_explained() {
        let error = TransportError::NoSuchTopic {
            topic: "/imu/dat".to_owned(),
            known: vec!["/imu/data".to_owned(), "/speed".to_owned()],
            nearest: Some("/imu/data".to_owned()),
        };
        assert_eq!(
            error.to_string(),
            "no topic `/imu/dat` (did you mean `/imu/data`?); there are: /imu/data, /speed"
        );
    }
}
