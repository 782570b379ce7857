//! The trait every source of samples implements, and what it hands over.

use std::fmt;
use std::sync::Arc;

use gleaner_base::words::hint;
use gleaner_messages::{Definitions, Endian, MessageError, SourcesError};

/// One topic that a caller wants to receive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicSpec {
    /// Absolute topic name, for example `/imu/data`.
    pub topic: String,
    /// Message type, `pkg/msg/Type` or `pkg/Type`; the two spellings are equal.
    pub type_name: String,
    /// How many samples a live transport may hold back before it drops the oldest. A replay is
    /// pulled and holds none.
    pub queue: usize,
    /// The largest sample, in bytes of CDR, that the sink will take. A live transport sizes its
    /// buffers by it; the sink alone decides and answers [`Verdict::TooBig`]. A larger sample that
    /// is packed is not unpacked to its end, and not shown to the sink: it is told by
    /// [`Sink::too_big`].
    pub max_bytes: usize,
    /// How a live transport asks for it.
    pub qos: Qos,
}

/// The quality of service that a subscription asks for. A replay delivers what it has.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub enum Qos {
    /// What the writers offer.
    #[default]
    Auto,
    /// Exactly this.
    Fixed {
        /// Whether lost samples are sent again.
        reliable: bool,
        /// Whether samples from before the subscription are wanted, as far as writers keep them.
        transient_local: bool,
        /// Samples that DDS keeps until we take them.
        depth: usize,
    },
}

/// How a subscription is doing.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Writers that are connected now; `None` where there are none, as in a replay. One that was
    /// killed counts until the time is over for which it said that it would be heard from, with ROS
    /// 2 often 10 to 20 s.
    pub writers: Option<usize>,
    /// Samples that were lost on their way to us, as far as gaps in their numbers tell; `None` if
    /// nothing tells.
    pub lost: Option<u64>,
    /// Samples that could not be read at all.
    pub malformed: u64,
    /// What is asked for now, in words: `reliable, volatile`.
    pub qos: Option<String>,
    /// What keeps writers from being heard, in whole sentences, at most 16.
    pub qos_warnings: Vec<String>,
}

/// The identity of whoever wrote a sample: 16 bytes, equal for all samples of one writer.
#[derive(Copy, Clone, PartialEq, Eq, Hash, Debug, Default, PartialOrd, Ord)]
pub struct Guid(pub [u8; 16]);

impl Guid {
    /// The identity that `text` spells as [`fmt::Display`] does: exactly 32 lower-case hex digits.
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
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// What is known of a sample besides its bytes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct SampleMeta {
    /// The clock that orders everything, in ns. Replay: log time. Live: receive time.
    pub at_ns: i64,
    /// When the writer published the sample, in ns of the writer's clock.
    pub publish_ns: i64,
    /// Who wrote it.
    pub writer: Guid,
    /// Strictly increasing per writer, at least 1. A gap is a loss before us.
    pub seq: u64,
    /// Byte order of the CDR payload.
    pub endian: Endian,
    /// Bytes 2 and 3 of the encapsulation header, nearly always zeros. Nothing reads them; with
    /// them a recorder can write the message again as it was, byte for byte.
    pub options: [u8; 2],
}

/// What a sink did with a sample.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Verdict {
    /// Copied and held.
    Taken,
    /// Dropped: no free memory to hold it.
    NoSlot,
    /// Dropped: larger than the sink's limit.
    TooBig,
}

/// Takes samples of one topic.
pub trait Sink: Send + Sync {
    /// Takes one sample; `cdr` is the payload without the four bytes of encapsulation.
    ///
    /// Runs on the transport's thread: one copy, no lock that a lambda can hold, never blocks.
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict;

    /// A sample was passed over that is larger than [`TopicSpec::max_bytes`]: it has at least `len`
    /// bytes of CDR. The verdict is [`Verdict::TooBig`]; whoever counts what it refuses counts it
    /// here.
    fn too_big(&self, _meta: &SampleMeta, _len: usize) {}

    /// Copies one sample, where a transport shows its bytes before it knows whose they are. `None`,
    /// as here: the sink wants both at once, so the transport makes a copy of its own for
    /// [`deliver`](Self::deliver).
    ///
    /// It may run under a lock of the transport: memory is copied, and nothing else is done.
    fn copy(&self, _cdr: &[u8]) -> Option<Verdict> {
        None
    }

    /// What the last [`copy`](Self::copy) took or refused was this sample. One that is copied and
    /// never accepted was none: the next copy takes its place.
    fn accept(&self, _meta: &SampleMeta) {}
}

/// A topic that a transport knows of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiscoveredTopic {
    /// Absolute topic name.
    pub topic: String,
    /// Message type as the source spells it.
    pub type_name: String,
    /// ros2msg text of the type and all it refers to, where the source carries it.
    pub definitions_text: Option<Arc<str>>,
    /// How many messages the source holds, where it says.
    pub messages: Option<u64>,
    /// The quality of service that the topic's writers offered, as rosbag2 notes it: YAML under the
    /// key `offered_qos_profiles`, at most 64 KiB. `None` where the source does not carry it.
    pub offered_qos: Option<String>,
}

/// Names one successful [`Transport::subscribe`]: 0 for the first of a transport, then counting up.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Subscription(pub usize);

/// A source of samples. Object safe and synchronous.
pub trait Transport {
    /// The topics known now, sorted by name. A live transport may learn of more later, and may know
    /// one of several types: the one that most write comes first.
    fn topics(&self) -> Vec<DiscoveredTopic>;

    /// Sends each sample of a topic to `sink` from now on. A topic may be subscribed several times;
    /// every subscription gets every sample, in the order of subscribing.
    ///
    /// # Errors
    ///
    /// [`TransportError`] if the topic does not exist, has another type or an encoding that we do
    /// not read, or if the transport can take no more subscriptions.
    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError>;

    /// The parsed message definitions of a topic, shared by all who ask.
    ///
    /// # Errors
    ///
    /// [`TransportError`] if there is no such topic, or its definitions are missing or malformed.
    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError>;

    /// Whether it is worth while to ask soon once more for the definitions of a topic that has
    /// none. A live transport asks whoever writes the topic, which takes at most some seconds; this
    /// sets it going.
    fn definitions_may_come(&self, _topic: &str) -> bool {
        false
    }

    /// How a subscription is doing.
    fn status(&self, _subscription: Subscription) -> Status {
        Status::default()
    }
}

/// Why a topic cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    /// The source has no topic of that name.
    #[error("no topic `{topic}`{}; there are: {}", hint(nearest), list(known))]
    NoSuchTopic {
        /// The name asked for.
        topic: String,
        /// The topics there are, sorted.
        known: Vec<String>,
        /// The closest of them, if one is close.
        nearest: Option<String>,
    },
    /// The topic carries another type.
    #[error("topic `{topic}` has type `{found}`, not `{wanted}`")]
    WrongType {
        /// The topic.
        topic: String,
        /// The type asked for.
        wanted: String,
        /// The type it has.
        found: String,
    },
    /// The topic is written in an encoding that we do not read.
    #[error("topic `{topic}` has {what} `{found}`; only `{wanted}` can be read")]
    Encoding {
        /// The topic.
        topic: String,
        /// Which encoding: "message encoding" or "schema encoding".
        what: &'static str,
        /// What the source uses.
        found: String,
        /// What we read.
        wanted: &'static str,
    },
    /// The source does not carry the definitions of this topic's type.
    #[error("topic `{topic}` has no message definitions for its type `{type_name}`")]
    NoDefinitions {
        /// The topic.
        topic: String,
        /// Its type.
        type_name: String,
    },
    /// The definitions that the source carries cannot be used.
    #[error("the message definitions of topic `{topic}` cannot be used")]
    BadDefinitions {
        /// The topic.
        topic: String,
        /// What is wrong with them.
        source: MessageError,
    },
    /// The definitions that were found for this topic's type, since the source does not carry them,
    /// cannot be used.
    #[error("the message definitions of topic `{topic}` cannot be used")]
    UnusableDefinitions {
        /// The topic.
        topic: String,
        /// What is wrong with them.
        source: Box<SourcesError>,
    },
    /// Replay: subscriptions are made before the first step.
    #[error("topic `{topic}` was subscribed after the replay started")]
    AlreadyStarted {
        /// The topic.
        topic: String,
    },
}

/// Most topics that are named in an error.
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

/// Whether two message type names mean the same type: `pkg/msg/Type` equals `pkg/Type`.
pub fn same_type(a: &str, b: &str) -> bool {
    gleaner_messages::short_name(a) == gleaner_messages::short_name(b)
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
    fn of_many_topics_a_missing_one_names_some() {
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
