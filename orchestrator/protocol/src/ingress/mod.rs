//! Messages between the ingress, the readers of its topics, and the program that starts them.
//!
//! The starter decides what a reader receives: it sends an [`AddReader`] with one end of a pair of
//! sockets to the ingress, and passes the other end to the reader. The reader requests no topics;
//! it receives descriptors of exactly those that were granted.

mod client;
mod control;
mod grant;
mod grant_check;
mod grant_rules;
mod message;
mod reader;
mod source;
#[cfg(test)]
mod tests;

pub use client::{IngressLink, IngressRequests, ReaderDelivery};
pub use control::{IngressControl, IngressRequest, IngressServer};
pub use grant::{AddReader, AddTopics, HoldGrant, PublishGrant, TopicGrant};
pub use grant_check::GrantError;
pub use message::{
    AttachedTopic, DISCOVERY_GROUP, IngressReport, IngressStatus, IngressTopic, JoinedParticipant,
    ReaderMessage, RefusedTopic, RegionLayout, SourceStatus, TopicInfo,
};
pub use reader::{PUBLISH_MAX, ReaderLink, ReaderRequest};
pub use source::{Health, Qos, ReceptionStatus};
