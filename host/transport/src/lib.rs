//! Where samples come from: the [`Transport`] trait, its implementations, and ROS 2 messages.
//!
//! - [`message`]: ROS 2 messages without code generation. Definitions are parsed from text, a field
//!   path is compiled once, and reading it from CDR bytes allocates nothing.
//! - [`replay`]: recorded drives (MCAP), pulled message by message in log-time order.
//! - `dds`: live topics of ROS 2, with the feature of that name.
//! - [`loopback`]: an in-process transport for tests and benches.
//!
//! What never happens here: waking a lambda, holding a sample, decoding pixels. A transport hands
//! the CDR bytes of each sample to a [`Sink`] and forgets them.

#[cfg(feature = "dds")]
pub mod dds;
mod gaps;
pub mod loopback;
pub mod message;
mod nearest;
pub mod replay;
mod transport;

pub use gaps::Gaps;
pub use message::Endian;
pub use transport::{
    DiscoveredTopic, Guid, Qos, SampleMeta, Sink, Status, Subscription, TopicSpec, Transport, TransportError, Verdict,
};
