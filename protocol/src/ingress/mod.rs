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
mod recorder_grants;
mod source;
#[cfg(test)]
mod tests;

pub use client::{IngressLink, IngressRequests, ReaderDelivery};
pub use control::{IngressControl, IngressRequest, IngressServer};
pub use grant::{AddReader, AddTopics, PinGrant, PublishGrant, TopicGrant};
pub use message::{
    AttachedTopic, DISCOVERY_GROUP, IngressReport, IngressStatus, IngressTopic, JoinedParticipant,
    ReaderMessage, RefusedTopic, RegionLayout, SourceStatus, TopicInfo,
};
pub use reader::{PUBLISH_MAX, ReaderLink, ReaderRequest};
pub use recorder_grants::{COMMANDS_ID, commands_grant, recorded_grant};
pub use source::{Health, Qos, ReceptionStatus};
