//! The subscribers of one topic of a drive that plays.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_messages::transport::{
    Clock, Delivery, Guid, PublishError, Publisher, SampleMeta, Sink, Subscription,
};

/// Passes the samples of a topic to its subscribers, stamped with the time of delivery.
pub(super) struct TopicRoute {
    type_name: String,
    clock: Clock,
    subscribers: Mutex<Vec<Subscriber>>,
}

struct Subscriber {
    subscription: Subscription,
    max_bytes: usize,
    sink: Arc<dyn Sink>,
}

impl TopicRoute {
    pub(super) fn new(type_name: String, clock: Clock) -> Self {
        Self { type_name, clock, subscribers: Mutex::default() }
    }

    pub(super) fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Returns the largest sample that a subscriber takes, in bytes.
    pub(super) fn max_bytes(&self) -> usize {
        self.lock().iter().map(|known| known.max_bytes).max().unwrap_or(0)
    }

    pub(super) fn add(&self, subscription: Subscription, max_bytes: usize, sink: Arc<dyn Sink>) {
        self.lock().push(Subscriber { subscription, max_bytes, sink });
    }

    pub(super) fn remove(&self, subscription: Subscription) {
        self.lock().retain(|known| known.subscription != subscription);
    }

    /// Moves the stamps of a sample to the present.
    fn stamped(&self, meta: &SampleMeta) -> SampleMeta {
        let at_ns = self.clock.now();
        let publish_ns = meta.publish_ns.saturating_add(at_ns.saturating_sub(meta.at_ns));
        SampleMeta { at_ns, publish_ns, ..*meta }
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Subscriber>> {
        self.subscribers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Sink for TopicRoute {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        // Locked meanwhile: a sink that was removed gets nothing more.
        let subscribers = self.lock();
        let meta = self.stamped(meta);
        let mut delivery = Delivery::Taken;
        for known in &*subscribers {
            delivery = known.sink.deliver(&meta, cdr);
        }
        delivery
    }

    fn too_big(&self, meta: &SampleMeta, len: usize) {
        let subscribers = self.lock();
        let meta = self.stamped(meta);
        subscribers.iter().for_each(|known| known.sink.too_big(&meta, len));
    }
}

pub(super) struct LoopedPublisher {
    route: Arc<TopicRoute>,
    writer: Guid,
    published: AtomicU64,
}

impl LoopedPublisher {
    pub(super) fn new(route: Arc<TopicRoute>, writer: Guid) -> Self {
        Self { route, writer, published: AtomicU64::new(0) }
    }
}

impl Publisher for LoopedPublisher {
    fn publish(&self, cdr: &[u8]) -> Result<(), PublishError> {
        let seq = self.published.fetch_add(1, Ordering::Relaxed) + 1;
        let at_ns = self.route.clock.now();
        let meta = SampleMeta::new(at_ns, self.writer, seq);
        self.route.deliver(&meta, cdr);
        Ok(())
    }
}
