//! Sources of samples: the [`Transport`] trait, the common part of live sources, and [`loopback`],
//! an in-process transport for tests and benches. Drives and DDS are crates of their own.
//!
//! A transport passes the CDR bytes of each sample to a [`Sink`] and keeps nothing. It never wakes
//! a lambda, stores a sample or decodes pixels.

pub mod clock;
mod gaps;
mod live;
pub mod loopback;
mod transport;

pub use clock::Clock;
pub use gaps::Gaps;
pub use live::{Health, LiveSource, PublishError, Publisher};
pub use transport::{
    Delivery, DiscoveredTopic, Guid, Qos, ReceptionStatus, SampleMeta, Sink, Subscription,
    TopicSpec, Transport, TransportError, same_type,
};
