//! A topic with readers: its subscription and its regions.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_buffers::shared::ReaderId;
use gleaner_messages::transport::{
    LiveSource, Qos, ReceptionStatus, Subscription, TopicSpec, TransportError, same_type,
};
use gleaner_protocol::ingress::{IngressTopic, TopicGrant};
use tracing::{info, warn};

use crate::rate_watch::RateWatch;
use crate::sink::{
    AttachRequest, AttachedReader, RegionId, RegionWriter, SubscriptionSink, TopicSink,
};
use crate::sizes::RegionSizes;

/// Time for which a topic has two subscriptions once the second one has received a sample: the
/// second may find some writers later than others.
const OVERLAP: Duration = Duration::from_secs(3);

const MAX_WARNINGS: usize = 16;

/// A topic with one subscription, or with two while one takes over from the other.
pub(crate) struct SharedTopic {
    spec: TopicSpec,
    sink: Arc<TopicSink>,
    /// `None` until the first reader is attached, so that it misses no sample.
    subscription: Option<Subscription>,
    /// Number of the subscription: 0, 1, ...
    number: u64,
    /// The subscription for smaller samples, which ends soon.
    previous: Option<PreviousSubscription>,
    /// Samples that subscriptions which have ended did not receive, by cause.
    earlier: ReceptionStatus,
    has_earlier: bool,
    /// The file and the reserved bytes of each region.
    regions: Vec<(RegionId, OwnedFd, u64)>,
    readers: usize,
    rate: RateWatch,
    pub(crate) status: ReceptionStatus,
}

struct PreviousSubscription {
    subscription: Subscription,
    /// Time at which the new one received a sample.
    since: Option<Instant>,
}

impl SharedTopic {
    /// Creates a topic without a reader and without a subscription.
    pub(crate) fn new(spec: TopicSpec) -> Self {
        Self {
            spec,
            sink: Arc::default(),
            subscription: None,
            number: 0,
            previous: None,
            earlier: ReceptionStatus::default(),
            has_earlier: false,
            regions: Vec::new(),
            readers: 0,
            rate: RateWatch::default(),
            status: ReceptionStatus::default(),
        }
    }

    pub(crate) fn name(&self) -> &str {
        &self.spec.topic
    }

    pub(crate) fn type_name(&self) -> &str {
        &self.spec.type_name
    }

    /// Returns whether this is the topic of a grant that resolved to `type_name`.
    pub(crate) fn is(&self, grant: &TopicGrant, type_name: &str) -> bool {
        let TopicSpec { topic, type_name: known, qos, .. } = &self.spec;
        *topic == grant.topic && *qos == grant.qos && same_type(known, type_name)
    }

    /// Returns whether a new reader receives the samples that are shown already, as it would from
    /// the network if it subscribed alone.
    pub(crate) fn is_latched(&self, source: &dyn LiveSource) -> bool {
        match (self.spec.qos, self.subscription) {
            (Qos::Fixed { transient_local, .. }, _) => transient_local,
            (Qos::Auto, Some(subscription)) => {
                source.status(subscription).qos.is_some_and(|qos| qos.contains("transient local"))
            }
            (Qos::Auto, None) => false,
        }
    }

    /// Returns the hash of the layout of its samples, if a writer has announced one.
    pub(crate) fn layout(&self, source: &dyn LiveSource) -> Option<String> {
        source.layout(self.subscription?)
    }

    /// Subscribes the topic, once more if a reader needs more than the subscription was made for.
    ///
    /// # Errors
    ///
    /// Those of the first subscription. Without a larger one, large samples may be lost.
    pub(crate) fn subscribe(
        &mut self,
        source: &mut dyn LiveSource,
        wanted: &TopicSpec,
    ) -> Result<(), TransportError> {
        let Some(current) = self.subscription else {
            let sink = SubscriptionSink { topic: Arc::clone(&self.sink), number: 0 };
            self.subscription = Some(source.subscribe(&self.spec, Arc::new(sink))?);
            info!(topic = self.spec.topic, type_name = self.spec.type_name, "subscribed");
            return Ok(());
        };
        if source.suffices(&self.spec, wanted) {
            return Ok(());
        }
        let spec = TopicSpec {
            max_bytes: wanted.max_bytes.max(self.spec.max_bytes),
            queue: wanted.queue.max(self.spec.queue),
            ..self.spec.clone()
        };
        self.sink.check_doubles();
        let number = self.number + 1;
        let sink = SubscriptionSink { topic: Arc::clone(&self.sink), number };
        match source.subscribe(&spec, Arc::new(sink)) {
            Ok(larger) => {
                self.subscription = Some(larger);
                (self.spec, self.number) = (spec, number);
                match &mut self.previous {
                    // The oldest one receives until the newest one does.
                    Some(previous) => {
                        previous.since = None;
                        self.end(source, current);
                    }
                    none => {
                        *none = Some(PreviousSubscription { subscription: current, since: None });
                    }
                }
            }
            Err(why) => {
                let (topic, error) = (&self.spec.topic, &why as &dyn std::error::Error);
                warn!(topic, error, "cannot subscribe for larger samples; they may be lost");
            }
        }
        Ok(())
    }

    /// Ends the previous subscription once the new one receives.
    pub(crate) fn take_over(&mut self, source: &mut dyn LiveSource, now: Instant) {
        let Some(previous) = &mut self.previous else { return };
        if self.sink.newest_subscription() < self.number {
            return;
        }
        if now.saturating_duration_since(*previous.since.get_or_insert(now)) >= OVERLAP {
            let ended = previous.subscription;
            self.previous = None;
            self.end(source, ended);
        }
    }

    pub(crate) fn has_two_subscriptions(&self) -> bool {
        self.previous.is_some()
    }

    fn end(&mut self, source: &mut dyn LiveSource, subscription: Subscription) {
        let status = source.status(subscription);
        self.earlier.malformed += status.malformed;
        self.earlier.lost = sum(self.earlier.lost, status.lost);
        if !std::mem::replace(&mut self.has_earlier, true) {
            self.earlier.before_match = status.before_match;
        }
        source.unsubscribe(subscription);
    }

    /// Attaches a reader to a region of samples up to `max_bytes`, new or not.
    pub(crate) fn attach(
        &mut self,
        max_bytes: u64,
        is_stated: bool,
        request: &AttachRequest<'_>,
    ) -> std::io::Result<AttachedReader> {
        let attached = match self.sink.attach(max_bytes, request) {
            Some(attached) => attached,
            None => {
                let quota = request.limits.quota();
                let sizes = RegionSizes::of(max_bytes, is_stated, request.depth, quota);
                let (region, file) = RegionWriter::create(sizes)?;
                let attached = self
                    .sink
                    .attach_to(region, request)
                    .map_err(|error| std::io::Error::other(format!("{error:?}")))?;
                let reserved = sizes.layout.bytes_needed().unwrap_or(0) as u64;
                self.regions.push((attached.region, file, reserved));
                attached
            }
        };
        self.readers += 1;
        Ok(attached)
    }

    /// Detaches a reader, and drops a region without readers.
    pub(crate) fn detach(&mut self, region: RegionId, reader: ReaderId) {
        if self.sink.detach(region, reader).is_some() {
            self.regions.retain(|(known, ..)| *known != region);
        }
        self.readers = self.readers.saturating_sub(1);
    }

    pub(crate) fn has_readers(&self) -> bool {
        self.readers > 0
    }

    pub(crate) fn file(&self, region: RegionId) -> Option<&OwnedFd> {
        self.regions.iter().find(|(known, ..)| *known == region).map(|(_, file, _)| file)
    }

    pub(crate) fn unsubscribe(self, source: &mut dyn LiveSource) {
        let previous = self.previous.map(|previous| previous.subscription);
        for subscription in [previous, self.subscription].into_iter().flatten() {
            info!(topic = self.spec.topic, "unsubscribed");
            source.unsubscribe(subscription);
        }
    }

    /// Updates the status of the subscription, and the counters that readers see.
    pub(crate) fn update_status(&mut self, source: &dyn LiveSource) {
        // The previous one shows what is missing until it ends.
        let previous = self.previous.as_ref().map(|previous| previous.subscription);
        let subscription = previous.or(self.subscription);
        let mut status = subscription.map(|known| source.status(known)).unwrap_or_default();
        status.malformed += self.earlier.malformed;
        status.lost = sum(status.lost, self.earlier.lost);
        if self.has_earlier {
            // What a later one did not receive before its match, an earlier one did.
            status.before_match = self.earlier.before_match;
        }
        let counts = (self.sink.counts().received, status.writers);
        let warning = self.rate.note(&self.spec.topic, counts, Instant::now());
        // First, so that others leave it its place.
        status.qos_warnings.splice(..0, warning);
        status.qos_warnings.truncate(MAX_WARNINGS);
        self.sink.set_lost(status.lost);
        self.status = status;
    }

    pub(crate) fn report(&self) -> IngressTopic {
        let counts = self.sink.counts();
        IngressTopic {
            topic: self.spec.topic.clone(),
            type_name: self.spec.type_name.clone(),
            readers: self.readers,
            received: counts.received,
            too_big: counts.too_big,
            reserved_bytes: self.regions.iter().map(|(_, _, bytes)| bytes).sum(),
            reception: self.status.clone(),
        }
    }
}

/// Adds two numbers, each of which may be unknown.
fn sum(one: Option<u64>, other: Option<u64>) -> Option<u64> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.saturating_add(other)),
        (known, None) | (None, known) => known,
    }
}
