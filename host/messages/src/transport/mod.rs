//! Sources of samples: the [`Transport`] trait, the common part of live sources, and [`loopback`],
//! an in-process transport for tests and benches. Drives and DDS are crates of their own.
//!
//! A transport passes the CDR bytes of each sample to a [`Sink`] and keeps nothing. It never wakes
//! a lambda, stores a sample or decodes pixels.

pub mod clock;
mod gaps;
mod latched;
mod live;
pub mod loopback;
mod source;
mod stored;

pub use clock::Clock;
pub use gaps::Gaps;
pub use gleaner_protocol::ingress::{Health, Qos, ReceptionStatus};
pub use latched::{LatchRule, LatchedSample, LatchedTopics, latched_depth};
pub use live::{LiveSource, PublishError, Publisher};
pub use source::{
    DefinitionsSearch, Delivery, DiscoveredTopic, Guid, SampleMeta, Sink, Subscription, TopicSpec,
    Transport, TransportError, live_definitions, same_type,
};
pub use stored::{ArrivalSums, STORED_WORDS, StoredMeta, TopicCounters};
