//! Messages between the ingress, the readers of its topics, and the program that starts them.
//!
//! The starter decides what a reader receives: it sends an [`AddReader`] with one end of a pair of
//! sockets to the ingress, and passes the other end to the reader. The reader requests no topics;
//! it receives descriptors of exactly those that were granted.

mod grant;
mod message;
mod source;

pub use grant::{AddReader, AddTopics, HoldGrant, PublishGrant, TopicGrant};
pub use message::{
    AttachedTopic, IngressReport, IngressStatus, IngressTopic, ReaderMessage, RefusedTopic,
    RegionLayout, SourceStatus,
};
pub use source::{Health, Qos, ReceptionStatus};
