//! Finds and subscribes the requested topics; checks the network and the disk once a second.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError};
use std::thread::Thread;
use std::time::{Duration, Instant};

use gleaner_base::visible;
use gleaner_transport::{
    DiscoveredTopic, Health, LiveSource, Qos, ReceptionStatus, Sink, Subscription, TopicSpec,
    TransportError,
};
use gleaner_vitals::usage;
use tracing::{error, warn};

use super::commands;
use super::connections::LoopEvent;
use crate::{TopicId, TopicSchema};

/// Interval of the search for topics.
const SEARCH_INTERVAL: Duration = Duration::from_millis(100);
/// Interval of the checks of network and disk.
const HEALTH_INTERVAL: Duration = Duration::from_secs(1);
/// Searches until a failed subscription is retried.
const RETRY_AFTER: u32 = 100;

/// A request for a topic.
pub(super) struct TopicRequest {
    pub(super) what: RequestKind,
    pub(super) name: String,
    /// Message type, if a manifest states it; `None` for the type with most writers.
    pub(super) type_name: Option<String>,
    pub(super) sink: Arc<dyn Sink>,
}

/// Time that a topic may wait for its definitions; other nodes are queried for other topics
/// meanwhile.
const DEFINITIONS_TIMEOUT: Duration = Duration::from_secs(6);

/// The purpose of a request.
#[derive(Copy, Clone, Debug)]
pub(super) enum RequestKind {
    /// Record it, once it is found and its type known.
    Recorded {
        topic: TopicId,
        /// The size of its samples. Of several requests for a topic, the largest counts.
        largest: LargestSample,
    },
    /// Receive commands. It is subscribed before there is a writer, where the network can do that:
    /// a command is written once.
    Commands,
}

/// The largest sample of a topic, as far as manifests state it.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct LargestSample {
    /// The largest size that a manifest states, in bytes.
    largest_bytes: usize,
    /// True if a manifest does not state it: then the usual size of its type counts as well.
    is_usual: bool,
}

impl LargestSample {
    /// Creates the size from that in one manifest, `None` if it states none.
    pub(super) fn of(max_bytes: Option<usize>) -> LargestSample {
        LargestSample { largest_bytes: max_bytes.unwrap_or(0), is_usual: max_bytes.is_none() }
    }

    /// Returns the larger of two.
    fn and(self, other: LargestSample) -> LargestSample {
        LargestSample {
            largest_bytes: self.largest_bytes.max(other.largest_bytes),
            is_usual: self.is_usual || other.is_usual,
        }
    }

    fn bytes(self, type_name: &str) -> usize {
        self.largest_bytes.max(if self.is_usual { usual_bytes(type_name) } else { 0 })
    }
}

/// An event of the watch thread.
pub(super) enum WatchEvent {
    /// A topic was found, and will be subscribed.
    Found { topic: TopicId, schema: TopicSchema },
    /// The checks of each second.
    Health(Box<SystemHealth>),
}

/// The health of the network, the disk and this process.
#[derive(Default)]
pub(super) struct SystemHealth {
    pub(super) source: Health,
    pub(super) topics: Vec<(TopicId, ReceptionStatus)>,
    pub(super) commands: Option<ReceptionStatus>,
    pub(super) disk_free: Option<u64>,
    pub(super) rss_bytes: u64,
    pub(super) cpu_s: f64,
}

/// A subscribed topic.
struct SubscribedTopic {
    topic: TopicId,
    subscription: Subscription,
    type_name: String,
    /// The largest sample of the subscription, in bytes.
    max_bytes: usize,
}

/// Adds a request; several for one topic are merged.
fn add(
    requested: &mut Vec<(TopicRequest, u32)>,
    subscribed: &[SubscribedTopic],
    request: TopicRequest,
) {
    let RequestKind::Recorded { topic, largest } = request.what else {
        return requested.push((request, 0));
    };
    let is_other = |known: &str| {
        if let Some(requested) =
            request.type_name.as_deref().filter(|requested| *requested != known)
        {
            let topic = visible(&request.name);
            warn!(
                %topic,
                %requested,
                recorded = %visible(known),
                "a topic is requested with two types; one is recorded"
            );
        }
    };
    if let Some(known) = subscribed.iter().find(|known| known.topic == topic) {
        is_other(&known.type_name);
        let (max_bytes, requested) = (known.max_bytes, largest.bytes(&known.type_name));
        if requested > max_bytes {
            let topic = visible(&request.name);
            warn!(
                %topic,
                requested,
                max_bytes,
                "already subscribed for smaller samples; larger ones may be lost"
            );
        }
        return;
    }
    for (known, _) in requested.iter_mut() {
        match &mut known.what {
            RequestKind::Recorded { topic: known_topic, largest: known_largest }
                if *known_topic == topic =>
            {
                *known_largest = known_largest.and(largest);
                match &known.type_name {
                    Some(known) => is_other(known),
                    None => known.type_name = request.type_name,
                }
                return;
            }
            _ => {}
        }
    }
    requested.push((request, 0));
}

/// The watch thread.
pub(super) struct TopicWatch {
    pub(super) source: Box<dyn LiveSource>,
    pub(super) requests: Receiver<TopicRequest>,
    pub(super) events: SyncSender<LoopEvent>,
    pub(super) reader: Thread,
    pub(super) out: PathBuf,
}

impl TopicWatch {
    /// Runs until the loop drops the request channel.
    pub(super) fn run(mut self) {
        let mut requested: Vec<(TopicRequest, u32)> = Vec::new();
        let (mut subscribed, mut commands) = (Vec::<SubscribedTopic>::new(), None);
        let mut health_at = Instant::now();
        // The start of each topic's wait for its definitions.
        let mut waiting_since: HashMap<String, Instant> = HashMap::new();
        // Topics with writers of several types, or of another type than requested, that were
        // logged.
        let mut mismatched: HashSet<String> = HashSet::new();
        loop {
            match self.requests.recv_timeout(SEARCH_INTERVAL) {
                // All queued requests at once: a search for topics takes longer.
                Ok(request) => std::iter::once(request)
                    .chain(std::iter::from_fn(|| self.requests.try_recv().ok()))
                    .for_each(|request| add(&mut requested, &subscribed, request)),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            if !requested.is_empty() {
                let topics = self.source.topics();
                requested.retain_mut(|(request, wait)| {
                    *wait = wait.saturating_sub(1);
                    let found = choose(&topics, request, &mut mismatched);
                    match (request.what, found) {
                        _ if *wait > 0 => return true,
                        // A node that writes it is queried for the definitions. The topic is not
                        // recorded meanwhile, so the wait is bounded.
                        (RequestKind::Recorded { .. }, Some(found))
                            if found.definitions_text.is_none()
                                && waiting_since
                                    .entry(request.name.clone())
                                    .or_insert_with(Instant::now)
                                    .elapsed()
                                    < DEFINITIONS_TIMEOUT
                                && self.source.definitions_may_come(&request.name) =>
                        {
                            return true;
                        }
                        (RequestKind::Recorded { topic, largest }, Some(found)) => {
                            match self.record(request, topic, largest, found) {
                                Some(topic) => subscribed.push(topic),
                                None => *wait = RETRY_AFTER,
                            }
                        }
                        (RequestKind::Recorded { .. }, None) => return true,
                        (RequestKind::Commands, _) => match self.subscribe_commands(request) {
                            Ok(subscription) => commands = Some(subscription),
                            Err(again) => *wait = again,
                        },
                    }
                    *wait > 0
                });
            }
            if health_at.elapsed() >= HEALTH_INTERVAL {
                health_at = Instant::now();
                let topics = subscribed
                    .iter()
                    .map(|known| (known.topic, self.source.status(known.subscription)))
                    .collect();
                let (rss_bytes, cpu_s) = (usage::resident(), usage::cpu_seconds());
                let disk_free = free(&self.out);
                let commands = commands.map(|subscription| self.source.status(subscription));
                let health = SystemHealth {
                    source: self.source.health(),
                    topics,
                    commands,
                    disk_free,
                    rss_bytes,
                    cpu_s,
                };
                match self.events.try_send(LoopEvent::Watch(WatchEvent::Health(Box::new(health)))) {
                    Ok(()) => self.reader.unpark(),
                    // The next one comes soon.
                    Err(TrySendError::Full(_)) => {}
                    Err(TrySendError::Disconnected(_)) => return,
                }
            }
        }
    }

    fn record(
        &mut self,
        request: &TopicRequest,
        topic: TopicId,
        largest: LargestSample,
        found: &DiscoveredTopic,
    ) -> Option<SubscribedTopic> {
        if found.definitions_text.is_none() {
            let (topic, type_name) = (visible(&request.name), visible(&found.type_name));
            warn!(
                %topic,
                %type_name,
                "no definitions of this type; recording its messages without"
            );
        }
        let schema = TopicSchema {
            name: request.name.clone(),
            type_name: found.type_name.clone(),
            definitions: found.definitions_text.clone(),
            offered_qos: found.offered_qos.clone(),
        };
        let max_bytes = largest.bytes(&found.type_name);
        let spec = TopicSpec {
            topic: request.name.clone(),
            type_name: found.type_name.clone(),
            queue: ((64 << 20) / max_bytes.max(1)).clamp(4, 1024),
            max_bytes,
            qos: Qos::Auto,
        };
        // Before its first sample.
        self.events.send(LoopEvent::Watch(WatchEvent::Found { topic, schema })).ok()?;
        match self.source.subscribe(&spec, Arc::clone(&request.sink)) {
            Ok(subscription) => {
                Some(SubscribedTopic { topic, subscription, type_name: spec.type_name, max_bytes })
            }
            Err(why) => {
                error!(
                    topic = %visible(&request.name),
                    error = &why as &dyn std::error::Error,
                    "cannot record a topic"
                );
                None
            }
        }
    }

    /// Subscribes the topic of commands; the error is the number of searches until the next
    /// attempt.
    fn subscribe_commands(&mut self, request: &TopicRequest) -> Result<Subscription, u32> {
        let spec = TopicSpec {
            topic: request.name.clone(),
            type_name: commands::TYPE.to_owned(),
            queue: commands::QUEUE,
            max_bytes: commands::MESSAGE_MAX,
            // Not earlier commands: they were executed already, or are outdated.
            qos: Qos::Fixed { reliable: true, transient_local: false, depth: commands::QUEUE },
        };
        self.source.subscribe(&spec, Arc::clone(&request.sink)).map_err(|why| match why {
            TransportError::NoSuchTopic { .. } => 1,
            why => {
                error!(
                    topic = %visible(&request.name),
                    error = &why as &dyn std::error::Error,
                    "cannot subscribe the topic of commands"
                );
                RETRY_AFTER
            }
        })
    }
}

/// Chooses the requested topic: with the type that a manifest states, else with the type with most
/// writers.
fn choose<'a>(
    topics: &'a [DiscoveredTopic],
    request: &TopicRequest,
    mismatched: &mut HashSet<String>,
) -> Option<&'a DiscoveredTopic> {
    let mut named = topics.iter().filter(|topic| topic.topic == request.name);
    let is_wanted = |found: &&DiscoveredTopic| {
        request.type_name.as_ref().is_none_or(|requested| found.type_name == *requested)
    };
    // The transport lists the type with most writers first.
    let found = named.clone().find(is_wanted);
    let chosen = found.map(|found| &found.type_name);
    if let Some(other) = named.find(|topic| Some(&topic.type_name) != chosen)
        && matches!(request.what, RequestKind::Recorded { .. })
        && mismatched.insert(request.name.clone())
    {
        let (topic, other) = (visible(&request.name), visible(&other.type_name));
        match (chosen, &request.type_name) {
            (Some(chosen), _) => {
                warn!(
                    %topic,
                    recorded = %visible(chosen),
                    %other,
                    "a topic has writers of several types; one type is recorded"
                );
            }
            (None, requested) => {
                let requested = requested.as_deref().unwrap_or_default();
                warn!(
                    %topic,
                    %requested,
                    %other,
                    "no writer of a topic has the type of the input; not recorded yet"
                );
            }
        }
    }
    found
}

/// Returns the size, in bytes, of the largest sample of a topic whose size no manifest states.
/// Larger samples may be dropped before they can be counted, so this is generous; the staging area,
/// which counts samples without room, is not.
fn usual_bytes(type_name: &str) -> usize {
    match type_name.rsplit('/').next() {
        Some("Image" | "PointCloud2") => 32 << 20,
        _ => 8 << 20,
    }
}

/// Returns the free bytes on the disk of `folder`.
fn free(folder: &Path) -> Option<u64> {
    rustix::fs::statvfs(folder).ok().map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_several_requests_for_a_topic_the_largest_sample_counts() {
        let image = "sensor_msgs/msg/Image";
        let largest_bytes = |bytes| LargestSample::of(Some(bytes));
        assert_eq!(
            largest_bytes(100).and(largest_bytes(300)).and(largest_bytes(200)).bytes(image),
            300
        );
        assert_eq!(
            largest_bytes(100).and(LargestSample::of(None)).bytes(image),
            32 << 20,
            "one manifest does not state it"
        );
        assert_eq!(LargestSample::of(None).and(largest_bytes(64 << 20)).bytes(image), 64 << 20);
    }
}
