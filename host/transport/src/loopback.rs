//! An in-process transport: what is published is delivered at once, on the publisher's thread.
//!
//! For tests and benches. It keeps nothing: a sample published before a subscription is gone.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use crate::transport::{
    DiscoveredTopic, SampleMeta, Sink, Subscription, TopicSpec, Transport, TransportError, Verdict, same_type,
};
use gleaner_base::words::nearest;
use gleaner_messages::Definitions;

/// The in-process transport.
#[derive(Default)]
pub struct Loopback {
    topics: BTreeMap<String, Topic>,
    subscriptions: usize,
}

struct Topic {
    type_name: String,
    text: Option<Arc<str>>,
    sinks: Vec<Arc<dyn Sink>>,
    messages: u64,
    definitions: OnceLock<Arc<Definitions>>,
}

impl Loopback {
    /// A transport without topics.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a topic; an empty `definitions_text` means that there is none. Replaces a topic of the
    /// same name, with its subscriptions.
    pub fn add_topic(&mut self, topic: &str, type_name: &str, definitions_text: &str) {
        let added = Topic {
            type_name: type_name.to_owned(),
            text: (!definitions_text.trim().is_empty()).then(|| definitions_text.into()),
            sinks: Vec::new(),
            messages: 0,
            definitions: OnceLock::new(),
        };
        self.topics.insert(topic.to_owned(), added);
    }

    /// Delivers one sample to every subscription of `topic`, in the order of subscribing, and
    /// returns the verdict of the last one; `None` if nobody has subscribed.
    ///
    /// # Errors
    ///
    /// [`TransportError::NoSuchTopic`] if the topic was never added.
    pub fn publish(&mut self, topic: &str, meta: &SampleMeta, cdr: &[u8]) -> Result<Option<Verdict>, TransportError> {
        let found = match self.topics.get_mut(topic) {
            Some(found) => found,
            None => return Err(self.no_such(topic)),
        };
        found.messages += 1;
        let mut verdict = None;
        for sink in &found.sinks {
            verdict = Some(sink.deliver(meta, cdr));
        }
        Ok(verdict)
    }

    fn get(&self, topic: &str) -> Result<&Topic, TransportError> {
        self.topics.get(topic).ok_or_else(|| self.no_such(topic))
    }

    fn no_such(&self, topic: &str) -> TransportError {
        TransportError::NoSuchTopic {
            topic: topic.to_owned(),
            known: self.topics.keys().cloned().collect(),
            nearest: nearest(topic, self.topics.keys().map(String::as_str)).map(str::to_owned),
        }
    }
}

impl Transport for Loopback {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        let discovered = |(name, topic): (&String, &Topic)| DiscoveredTopic {
            topic: name.clone(),
            type_name: topic.type_name.clone(),
            definitions_text: topic.text.clone(),
            messages: Some(topic.messages),
            offered_qos: None,
        };
        self.topics.iter().map(discovered).collect()
    }

    fn subscribe(&mut self, spec: &TopicSpec, sink: Arc<dyn Sink>) -> Result<Subscription, TransportError> {
        let found = self.get(&spec.topic)?;
        if !same_type(&found.type_name, &spec.type_name) {
            return Err(TransportError::WrongType {
                topic: spec.topic.clone(),
                wanted: spec.type_name.clone(),
                found: found.type_name.clone(),
            });
        }
        if let Some(found) = self.topics.get_mut(&spec.topic) {
            found.sinks.push(sink);
        }
        let subscription = Subscription(self.subscriptions);
        self.subscriptions += 1;
        Ok(subscription)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        let found = self.get(topic)?;
        if let Some(known) = found.definitions.get() {
            return Ok(known.clone());
        }
        let text = found.text.as_deref().ok_or_else(|| TransportError::NoDefinitions {
            topic: topic.to_owned(),
            type_name: found.type_name.clone(),
        })?;
        let parsed = Definitions::parse(&found.type_name, text)
            .map_err(|source| TransportError::BadDefinitions { topic: topic.to_owned(), source })?;
        Ok(found.definitions.get_or_init(|| Arc::new(parsed)).clone())
    }
}
