//! An in-process transport, for tests and benches: a published sample is delivered at once, on the
//! publisher's thread.
//!
//! It keeps no samples: one that is published before a subscription is lost.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use crate::Definitions;
use gleaner_base::text::nearest;

use crate::transport::Health;
use crate::transport::clock::Clock;
use crate::transport::live::{LiveSource, PublishError, Publisher};
use crate::transport::{
    Delivery, DiscoveredTopic, Guid, SampleMeta, Sink, Subscription, TopicSpec, Transport,
    TransportError, same_type,
};

/// The in-process transport. Clones share it: one publishes, another one subscribes.
#[derive(Clone, Default)]
pub struct Loopback(Arc<Mutex<LoopbackState>>);

#[derive(Default)]
struct LoopbackState {
    topics: BTreeMap<String, LoopbackTopic>,
    subscriptions: usize,
    dead: Option<String>,
}

struct LoopbackTopic {
    type_name: String,
    text: Option<Arc<str>>,
    sinks: Vec<(Subscription, Arc<dyn Sink>)>,
    messages: u64,
    definitions: OnceLock<Arc<Definitions>>,
}

impl Loopback {
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a topic; an empty `definitions_text` means none. Replaces a topic of the same name,
    /// with its subscriptions.
    pub fn add_topic(&self, topic: &str, type_name: &str, definitions_text: &str) {
        let added = LoopbackTopic {
            type_name: type_name.to_owned(),
            text: (!definitions_text.trim().is_empty()).then(|| definitions_text.into()),
            sinks: Vec::new(),
            messages: 0,
            definitions: OnceLock::new(),
        };
        self.lock().topics.insert(topic.to_owned(), added);
    }

    /// Delivers a sample to every subscription of `topic`, in the order of subscribing. Returns the
    /// result of the last one; `None` without subscriptions.
    ///
    /// # Errors
    ///
    /// [`TransportError::NoSuchTopic`] if the topic was never added.
    pub fn publish(
        &self,
        topic: &str,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<Option<Delivery>, TransportError> {
        // Not locked during delivery: a sink may publish in turn.
        let sinks = {
            let mut topics = self.lock();
            match topics.topics.get_mut(topic) {
                Some(found) => {
                    found.messages += 1;
                    found.sinks.clone()
                }
                None => return Err(topics.no_such(topic)),
            }
        };
        let mut delivery = None;
        for (_, sink) in sinks {
            delivery = Some(sink.deliver(meta, cdr));
        }
        Ok(delivery)
    }

    /// Makes [`LiveSource::health`] report a failure, with the reason `why`.
    pub fn fail(&self, why: &str) {
        self.lock().dead = Some(why.to_owned());
    }

    fn lock(&self) -> MutexGuard<'_, LoopbackState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LoopbackState {
    fn get(&self, topic: &str) -> Result<&LoopbackTopic, TransportError> {
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
        let discovered = |(name, topic): (&String, &LoopbackTopic)| DiscoveredTopic {
            topic: name.clone(),
            type_name: topic.type_name.clone(),
            definitions_text: topic.text.clone(),
            messages: Some(topic.messages),
            ..DiscoveredTopic::default()
        };
        self.lock().topics.iter().map(discovered).collect()
    }

    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        let mut topics = self.lock();
        let found = topics.get(&spec.topic)?;
        if !same_type(&found.type_name, &spec.type_name) {
            return Err(TransportError::WrongType {
                topic: spec.topic.clone(),
                wanted: spec.type_name.clone(),
                found: found.type_name.clone(),
            });
        }
        let subscription = Subscription(topics.subscriptions);
        if let Some(found) = topics.topics.get_mut(&spec.topic) {
            found.sinks.push((subscription, sink));
        }
        topics.subscriptions += 1;
        Ok(subscription)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        let topics = self.lock();
        let found = topics.get(topic)?;
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

/// Published samples are stamped by the time of day, and numbered from 1.
impl LiveSource for Loopback {
    fn health(&self) -> Health {
        Health { network: None, dead: self.lock().dead.clone() }
    }

    fn unsubscribe(&mut self, subscription: Subscription) {
        for topic in self.lock().topics.values_mut() {
            topic.sinks.retain(|(known, _)| *known != subscription);
        }
    }

    fn publisher(
        &self,
        topic: &str,
        _type_name: &str,
        _depth: usize,
    ) -> Result<Box<dyn Publisher>, PublishError> {
        self.lock().get(topic).map_err(|error| PublishError(error.into()))?;
        let published = LoopbackPublisher {
            loopback: self.clone(),
            topic: topic.to_owned(),
            clock: Clock::from_time_of_day(),
            messages: AtomicU64::new(0),
        };
        Ok(Box::new(published))
    }
}

struct LoopbackPublisher {
    loopback: Loopback,
    topic: String,
    clock: Clock,
    messages: AtomicU64,
}

impl Publisher for LoopbackPublisher {
    fn publish(&self, cdr: &[u8]) -> Result<(), PublishError> {
        let at_ns = self.clock.now();
        let seq = self.messages.fetch_add(1, Ordering::Relaxed) + 1;
        let meta = SampleMeta::new(at_ns, Guid(*b"gleaner loopback"), seq);
        self.loopback
            .publish(&self.topic, &meta, cdr)
            .map(drop)
            .map_err(|error| PublishError(error.into()))
    }
}
