//! All topics that have readers.

use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::time::Instant;

use gleaner_buffers::shared::PinLimits;
use gleaner_messages::transport::{LiveSource, TopicSpec, TransportError};
use gleaner_protocol::ingress::{RefusedTopic, TopicGrant};
use gleaner_samples::regions::ControlRegion;

use crate::sink::{AttachRequest, AttachedReader};
use crate::sizes::usual_bytes;
use crate::topic::SharedTopic;

/// The topics with readers, by keys that never repeat.
#[derive(Default)]
pub(crate) struct TopicTable {
    topics: BTreeMap<u64, SharedTopic>,
    next: u64,
}

impl TopicTable {
    /// Attaches a reader to the topic of a grant, of type `type_name`; returns the topic's key.
    pub(crate) fn attach(
        &mut self,
        source: &mut dyn LiveSource,
        grant: &TopicGrant,
        type_name: &str,
        (control, limits): (&ControlRegion, PinLimits),
    ) -> Result<(u64, AttachedReader), RefusedTopic> {
        let max_bytes = grant.max_bytes.unwrap_or_else(|| usual_bytes(type_name));
        let spec = TopicSpec {
            topic: grant.topic.clone(),
            type_name: type_name.to_owned(),
            queue: grant.queue,
            max_bytes: usize::try_from(max_bytes).unwrap_or(usize::MAX),
            qos: grant.qos,
        };
        let known = self.topics.iter().find(|(_, topic)| topic.is(grant, type_name));
        let key = known.map_or(self.next, |(key, _)| *key);
        let topic = self.topics.entry(key).or_insert_with(|| SharedTopic::new(spec.clone()));
        self.next = self.next.max(key + 1);
        let request = AttachRequest {
            control,
            limits,
            depth: grant.depth,
            wakes: grant.wakes,
            digests: grant.digests,
            is_latched: grant.shown || topic.is_latched(source),
        };
        let attached = match topic.attach(max_bytes, grant.max_bytes.is_some(), &request) {
            Ok(attached) => attached,
            Err(why) => {
                self.remove_unused(source, key);
                let what = format!("there is no memory for topic `{}`", grant.topic);
                return Err(RefusedTopic::Other(vec![what, why.to_string()]));
            }
        };
        if let Err(why) = topic.subscribe(source, &spec) {
            self.detach(source, key, &attached);
            return Err(refusal(why));
        }
        Ok((key, attached))
    }

    /// Detaches a reader, and unsubscribes a topic without readers.
    pub(crate) fn detach(
        &mut self,
        source: &mut dyn LiveSource,
        key: u64,
        attached: &AttachedReader,
    ) {
        if let Some(topic) = self.topics.get_mut(&key) {
            topic.detach(attached.region, attached.id);
        }
        self.remove_unused(source, key);
    }

    fn remove_unused(&mut self, source: &mut dyn LiveSource, key: u64) {
        if self.topics.get(&key).is_some_and(|topic| !topic.has_readers())
            && let Some(topic) = self.topics.remove(&key)
        {
            topic.unsubscribe(source);
        }
    }

    pub(crate) fn get(&self, key: u64) -> Option<&SharedTopic> {
        self.topics.get(&key)
    }

    /// Returns the hash of the layout of a topic's samples, if a writer has announced one.
    pub(crate) fn layout(&self, source: &dyn LiveSource, key: u64) -> Option<String> {
        self.get(key)?.layout(source)
    }

    pub(crate) fn all(&self) -> impl Iterator<Item = &SharedTopic> {
        self.topics.values()
    }

    pub(crate) fn file(&self, key: u64, attached: &AttachedReader) -> Option<&OwnedFd> {
        self.topics.get(&key)?.file(attached.region)
    }

    /// Returns whether a subscription takes over from another one.
    pub(crate) fn has_two_subscriptions(&self) -> bool {
        self.topics.values().any(SharedTopic::has_two_subscriptions)
    }

    /// Ends subscriptions that another one has taken over from.
    pub(crate) fn take_over(&mut self, source: &mut dyn LiveSource, now: Instant) {
        self.topics.values_mut().for_each(|topic| topic.take_over(source, now));
    }

    pub(crate) fn update_status(&mut self, source: &dyn LiveSource) {
        self.topics.values_mut().for_each(|topic| topic.update_status(source));
    }
}

fn refusal(error: TransportError) -> RefusedTopic {
    match error {
        TransportError::NoSuchTopic { known, nearest, .. } => {
            RefusedTopic::NoSuchTopic { known, nearest }
        }
        TransportError::WrongType { found, .. } => RefusedTopic::WrongType { found },
        other => {
            let mut texts = vec![other.to_string()];
            let mut cause = std::error::Error::source(&other);
            while let Some(why) = cause {
                texts.push(why.to_string());
                cause = why.source();
            }
            RefusedTopic::Other(texts)
        }
    }
}
