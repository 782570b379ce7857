//! Finds the topics that are wanted and subscribes them; looks after the network and the disk once
//! a second.

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

/// How often topics are looked for.
const SEARCH_INTERVAL: Duration = Duration::from_millis(100);
/// How often network and disk are looked after.
const HEALTH_INTERVAL: Duration = Duration::from_secs(1);
/// Looks until a topic that could not be subscribed is tried again.
const RETRY_AFTER: u32 = 100;

/// A topic that is to be heard.
pub(super) struct TopicRequest {
    pub(super) what: RequestKind,
    pub(super) name: String,
    /// Its type, where a manifest says it; else the one that most write.
    pub(super) type_name: Option<String>,
    pub(super) sink: Arc<dyn Sink>,
}

/// How long a topic may wait for somebody to say what it is; others are asked about others
/// meanwhile.
const DEFINITIONS_TIMEOUT: Duration = Duration::from_secs(6);

/// What a topic is wanted for.
#[derive(Copy, Clone, Debug)]
pub(super) enum RequestKind {
    /// To be recorded, once it is there and its type known.
    Recorded {
        topic: TopicId,
        /// How large its samples are. Of several wants of a topic, the largest counts.
        largest: LargestSample,
    },
    /// Commands come over it. It is heard before anybody writes, where the network can do that: a
    /// command is written once.
    Commands,
}

/// How large the samples of a topic may be, as far as manifests say.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct LargestSample {
    /// The most that a manifest says, in bytes.
    largest_bytes: usize,
    /// Whether somebody wants it whose manifest does not say: the usual size of its type counts as
    /// well.
    is_usual: bool,
}

impl LargestSample {
    /// What one manifest says.
    pub(super) fn of(max_bytes: Option<usize>) -> LargestSample {
        LargestSample { largest_bytes: max_bytes.unwrap_or(0), is_usual: max_bytes.is_none() }
    }

    /// What two of them say.
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

/// What was seen.
pub(super) enum WatchEvent {
    /// A topic is there, and will be heard.
    Found { topic: TopicId, of: TopicSchema },
    /// Once a second.
    Health(Box<SystemHealth>),
}

/// How everything outside is.
#[derive(Default)]
pub(super) struct SystemHealth {
    pub(super) source: Health,
    pub(super) topics: Vec<(TopicId, ReceptionStatus)>,
    pub(super) commands: Option<ReceptionStatus>,
    pub(super) disk_free: Option<u64>,
    pub(super) rss_bytes: u64,
    pub(super) cpu_s: f64,
}

/// A topic that is heard.
struct SubscribedTopic {
    topic: TopicId,
    subscription: Subscription,
    type_name: String,
    /// What it was subscribed for.
    max_bytes: usize,
}

/// Adds a want; several for one topic are one.
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
                "a topic is wanted as two types, and recorded as one"
            );
        }
    };
    if let Some(of) = subscribed.iter().find(|of| of.topic == topic) {
        is_other(&of.type_name);
        let (max_bytes, requested) = (of.max_bytes, largest.bytes(&of.type_name));
        if requested > max_bytes {
            let topic = visible(&request.name);
            warn!(
                %topic,
                requested,
                max_bytes,
                "a topic is heard already, with room for smaller samples: more of them may be lost"
            );
        }
        return;
    }
    for (known, _) in requested.iter_mut() {
        match &mut known.what {
            RequestKind::Recorded { topic: of, largest: known_largest } if *of == topic => {
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

/// The thread's own.
pub(super) struct TopicWatch {
    pub(super) source: Box<dyn LiveSource>,
    pub(super) requests: Receiver<TopicRequest>,
    pub(super) events: SyncSender<LoopEvent>,
    pub(super) reader: Thread,
    pub(super) out: PathBuf,
}

impl TopicWatch {
    /// Until nobody wants anything more.
    pub(super) fn run(mut self) {
        let mut requested: Vec<(TopicRequest, u32)> = Vec::new();
        let (mut subscribed, mut commands) = (Vec::<SubscribedTopic>::new(), None);
        let mut health_at = Instant::now();
        // Since when each topic waits for its definitions.
        let mut waiting_since: HashMap<String, Instant> = HashMap::new();
        // Topics that were found as several types, or as another than is wanted; what they are was
        // said.
        let mut odd: HashSet<String> = HashSet::new();
        loop {
            match self.requests.recv_timeout(SEARCH_INTERVAL) {
                // All that wait at once: to look for topics takes longer.
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
                    let found = choose(&topics, request, &mut odd);
                    match (request.what, found) {
                        _ if *wait > 0 => return true,
                        // Whoever writes it is asked what it is. Until then it is not recorded, so
                        // it is not waited for longer.
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
                                Some(of) => subscribed.push(of),
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
                    .map(|of| (of.topic, self.source.status(of.subscription)))
                    .collect();
                let (rss_bytes, cpu_s) = (usage::resident(), usage::cpu_seconds());
                let disk_free = free(&self.out);
                let commands = commands.map(|of| self.source.status(of));
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
                "no definitions of this type: its messages are recorded without"
            );
        }
        let of = TopicSchema {
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
        self.events.send(LoopEvent::Watch(WatchEvent::Found { topic, of })).ok()?;
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

    /// Or after how many looks to try again.
    fn subscribe_commands(&mut self, request: &TopicRequest) -> Result<Subscription, u32> {
        let spec = TopicSpec {
            topic: request.name.clone(),
            type_name: commands::TYPE.to_owned(),
            queue: commands::QUEUE,
            max_bytes: commands::MESSAGE_MAX,
            // Not those from before: they are obeyed already, or nobody wants them any more.
            qos: Qos::Fixed { reliable: true, transient_local: false, depth: commands::QUEUE },
        };
        self.source.subscribe(&spec, Arc::clone(&request.sink)).map_err(|why| match why {
            TransportError::NoSuchTopic { .. } => 1,
            why => {
                error!(
                    topic = %visible(&request.name),
                    error = &why as &dyn std::error::Error,
                    "cannot hear commands"
                );
                RETRY_AFTER
            }
        })
    }
}

/// Of what is there, the topic that is wanted: of the type that a manifest says, else of the one
/// that most write.
fn choose<'a>(
    topics: &'a [DiscoveredTopic],
    request: &TopicRequest,
    odd: &mut HashSet<String>,
) -> Option<&'a DiscoveredTopic> {
    let mut named = topics.iter().filter(|topic| topic.topic == request.name);
    let is_wanted = |found: &&DiscoveredTopic| {
        request.type_name.as_ref().is_none_or(|requested| found.type_name == *requested)
    };
    // The transport names first what most write.
    let found = named.clone().find(is_wanted);
    let chosen = found.map(|found| &found.type_name);
    if let Some(other) = named.find(|topic| Some(&topic.type_name) != chosen)
        && matches!(request.what, RequestKind::Recorded { .. })
        && odd.insert(request.name.clone())
    {
        let (topic, other) = (visible(&request.name), visible(&other.type_name));
        match (chosen, &request.type_name) {
            (Some(chosen), _) => {
                warn!(
                    %topic,
                    recorded = %visible(chosen),
                    %other,
                    "a topic is written as several types, one is recorded"
                );
            }
            (None, requested) => {
                let requested = requested.as_deref().unwrap_or_default();
                warn!(
                    %topic,
                    %requested,
                    %other,
                    "a topic is written as another type than the input says, not recorded so far"
                );
            }
        }
    }
    found
}

/// Bytes of the largest sample of a topic of which no manifest says more. What is larger may be
/// dropped before anybody can count it, so this is generous; the staging area, which counts what it
/// has no room for, is not.
fn usual_bytes(type_name: &str) -> usize {
    match type_name.rsplit('/').next() {
        Some("Image" | "PointCloud2") => 32 << 20,
        _ => 8 << 20,
    }
}

/// Bytes that are free on the disk of `folder`.
fn free(folder: &Path) -> Option<u64> {
    rustix::fs::statvfs(folder).ok().map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_several_who_want_a_topic_the_largest_sample_counts() {
        let image = "sensor_msgs/msg/Image";
        let largest_bytes = |bytes| LargestSample::of(Some(bytes));
        assert_eq!(
            largest_bytes(100).and(largest_bytes(300)).and(largest_bytes(200)).bytes(image),
            300
        );
        assert_eq!(
            largest_bytes(100).and(LargestSample::of(None)).bytes(image),
            32 << 20,
            "somebody does not know"
        );
        assert_eq!(LargestSample::of(None).and(largest_bytes(64 << 20)).bytes(image), 64 << 20);
    }
}
