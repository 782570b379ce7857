//! Where samples come from: the [`Transport`] trait, what every live source of samples has, and
//! [`loopback`], an in-process transport for tests and benches. Drives and DDS are crates of their
//! own.
//!
//! What never happens here: waking a lambda, holding a sample, decoding pixels. A transport hands
//! the CDR bytes of each sample to a [`Sink`] and forgets them.

pub mod clock;
mod gaps;
mod live;
pub mod loopback;
mod transport;

pub use clock::Clock;
pub use gaps::Gaps;
pub use live::{Health, LiveSource, PublishError, Publisher};
pub use transport::{
    DiscoveredTopic, Guid, Qos, SampleMeta, Sink, Status, Subscription, TopicSpec, Transport,
    TransportError, Verdict, same_type,
};
