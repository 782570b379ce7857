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
    DiscoveredTopic, Health, LiveSource, Qos, Sink, Status, Subscription, TopicSpec, TransportError,
};
use gleaner_vitals::usage;
use tracing::{error, warn};

use super::commands;
use super::hear::Event;
use crate::{Topic, TopicId};

/// How often topics are looked for.
const LOOK: Duration = Duration::from_millis(100);
/// How often network and disk are looked after.
const PULSE: Duration = Duration::from_secs(1);
/// Looks until a topic that could not be subscribed is tried again.
const AGAIN: u32 = 100;

/// A topic that is to be heard.
pub(super) struct Want {
    pub(super) what: Wanted,
    pub(super) name: String,
    /// Its type, where a manifest says it; else the one that most write.
    pub(super) type_name: Option<String>,
    pub(super) sink: Arc<dyn Sink>,
}

/// How long a topic may wait for somebody to say what it is; others are asked about others
/// meanwhile.
const ASKING: Duration = Duration::from_secs(6);

/// What a topic is wanted for.
#[derive(Copy, Clone, Debug)]
pub(super) enum Wanted {
    /// To be recorded, once it is there and its type known.
    Recorded {
        topic: TopicId,
        /// How large its samples are. Of several wants of a topic, the largest counts.
        largest: Largest,
    },
    /// Commands come over it. It is heard before anybody writes, where the network can do that: a
    /// command is written once.
    Commands,
}

/// How large the samples of a topic may be, as far as manifests say.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct Largest {
    /// The most that a manifest says, in bytes.
    said: usize,
    /// Whether somebody wants it whose manifest does not say: the usual size of its type counts as
    /// well.
    is_usual: bool,
}

impl Largest {
    /// What one manifest says.
    pub(super) fn of(max_bytes: Option<usize>) -> Largest {
        Largest { said: max_bytes.unwrap_or(0), is_usual: max_bytes.is_none() }
    }

    /// What two of them say.
    fn and(self, other: Largest) -> Largest {
        Largest { said: self.said.max(other.said), is_usual: self.is_usual || other.is_usual }
    }

    fn bytes(self, type_name: &str) -> usize {
        self.said.max(if self.is_usual { usual_bytes(type_name) } else { 0 })
    }
}

/// What was seen.
pub(super) enum Seen {
    /// A topic is there, and will be heard.
    Found { topic: TopicId, of: Topic },
    /// Once a second.
    Pulse(Box<Beat>),
}

/// How everything outside is.
#[derive(Default)]
pub(super) struct Beat {
    pub(super) health: Health,
    pub(super) topics: Vec<(TopicId, Status)>,
    pub(super) commands: Option<Status>,
    pub(super) disk_free: Option<u64>,
    pub(super) rss_bytes: u64,
    pub(super) cpu_s: f64,
}

/// A topic that is heard.
struct Heard {
    topic: TopicId,
    subscription: Subscription,
    type_name: String,
    /// What it was subscribed for.
    max_bytes: usize,
}

/// Adds a want; several for one topic are one.
fn add(wanted: &mut Vec<(Want, u32)>, heard: &[Heard], want: Want) {
    let Wanted::Recorded { topic, largest } = want.what else { return wanted.push((want, 0)) };
    let is_other = |known: &str| {
        if let Some(wanted) = want.type_name.as_deref().filter(|wanted| *wanted != known) {
            let topic = visible(&want.name);
            warn!(%topic, %wanted, recorded = %visible(known), "a topic is wanted as two types, and recorded as one");
        }
    };
    if let Some(of) = heard.iter().find(|of| of.topic == topic) {
        is_other(&of.type_name);
        let (max_bytes, wanted) = (of.max_bytes, largest.bytes(&of.type_name));
        if wanted > max_bytes {
            let topic = visible(&want.name);
            warn!(%topic, wanted, max_bytes, "a topic is heard already, with room for smaller samples: more of them may be lost");
        }
        return;
    }
    for (known, _) in wanted.iter_mut() {
        match &mut known.what {
            Wanted::Recorded { topic: of, largest: known_largest } if *of == topic => {
                *known_largest = known_largest.and(largest);
                match &known.type_name {
                    Some(known) => is_other(known),
                    None => known.type_name = want.type_name,
                }
                return;
            }
            _ => {}
        }
    }
    wanted.push((want, 0));
}

/// The thread's own.
pub(super) struct Watch {
    pub(super) source: Box<dyn LiveSource>,
    pub(super) wants: Receiver<Want>,
    pub(super) events: SyncSender<Event>,
    pub(super) reader: Thread,
    pub(super) out: PathBuf,
}

impl Watch {
    /// Until nobody wants anything more.
    pub(super) fn run(mut self) {
        let mut wanted: Vec<(Want, u32)> = Vec::new();
        let (mut heard, mut commands) = (Vec::<Heard>::new(), None);
        let mut beat_at = Instant::now();
        // Since when each topic waits for its definitions.
        let mut asking: HashMap<String, Instant> = HashMap::new();
        // Topics that were found as several types, or as another than is wanted; what they are was
        // said.
        let mut odd: HashSet<String> = HashSet::new();
        loop {
            match self.wants.recv_timeout(LOOK) {
                // All that wait at once: to look for topics takes longer.
                Ok(want) => std::iter::once(want)
                    .chain(std::iter::from_fn(|| self.wants.try_recv().ok()))
                    .for_each(|want| add(&mut wanted, &heard, want)),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            if !wanted.is_empty() {
                let topics = self.source.topics();
                wanted.retain_mut(|(want, wait)| {
                    *wait = wait.saturating_sub(1);
                    let found = choose(&topics, want, &mut odd);
                    match (want.what, found) {
                        _ if *wait > 0 => return true,
                        // Whoever writes it is asked what it is. Until then it is not recorded, so
                        // it is not waited for longer.
                        (Wanted::Recorded { .. }, Some(found))
                            if found.definitions_text.is_none()
                                && asking
                                    .entry(want.name.clone())
                                    .or_insert_with(Instant::now)
                                    .elapsed()
                                    < ASKING
                                && self.source.definitions_may_come(&want.name) =>
                        {
                            return true;
                        }
                        (Wanted::Recorded { topic, largest }, Some(found)) => {
                            match self.record(want, topic, largest, found) {
                                Some(of) => heard.push(of),
                                None => *wait = AGAIN,
                            }
                        }
                        (Wanted::Recorded { .. }, None) => return true,
                        (Wanted::Commands, _) => match self.hear_commands(want) {
                            Ok(subscription) => commands = Some(subscription),
                            Err(again) => *wait = again,
                        },
                    }
                    *wait > 0
                });
            }
            if beat_at.elapsed() >= PULSE {
                beat_at = Instant::now();
                let topics = heard
                    .iter()
                    .map(|of| (of.topic, self.source.status(of.subscription)))
                    .collect();
                let (rss_bytes, cpu_s) = (usage::resident(), usage::cpu_seconds());
                let disk_free = free(&self.out);
                let commands = commands.map(|of| self.source.status(of));
                let beat = Beat {
                    health: self.source.health(),
                    topics,
                    commands,
                    disk_free,
                    rss_bytes,
                    cpu_s,
                };
                match self.events.try_send(Event::Seen(Seen::Pulse(Box::new(beat)))) {
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
        want: &Want,
        topic: TopicId,
        largest: Largest,
        found: &DiscoveredTopic,
    ) -> Option<Heard> {
        if found.definitions_text.is_none() {
            let (topic, type_name) = (visible(&want.name), visible(&found.type_name));
            warn!(%topic, %type_name, "no definitions of this type: its messages are recorded without");
        }
        let of = Topic {
            name: want.name.clone(),
            type_name: found.type_name.clone(),
            definitions: found.definitions_text.clone(),
            offered_qos: found.offered_qos.clone(),
        };
        let max_bytes = largest.bytes(&found.type_name);
        let spec = TopicSpec {
            topic: want.name.clone(),
            type_name: found.type_name.clone(),
            queue: ((64 << 20) / max_bytes.max(1)).clamp(4, 1024),
            max_bytes,
            qos: Qos::Auto,
        };
        // Before its first sample.
        self.events.send(Event::Seen(Seen::Found { topic, of })).ok()?;
        match self.source.subscribe(&spec, Arc::clone(&want.sink)) {
            Ok(subscription) => {
                Some(Heard { topic, subscription, type_name: spec.type_name, max_bytes })
            }
            Err(why) => {
                error!(topic = %visible(&want.name), error = &why as &dyn std::error::Error, "cannot record a topic");
                None
            }
        }
    }

    /// Or after how many looks to try again.
    fn hear_commands(&mut self, want: &Want) -> Result<Subscription, u32> {
        let spec = TopicSpec {
            topic: want.name.clone(),
            type_name: commands::TYPE.to_owned(),
            queue: commands::QUEUE,
            max_bytes: commands::MESSAGE_MAX,
            // Not those from before: they are obeyed already, or nobody wants them any more.
            qos: Qos::Fixed { reliable: true, transient_local: false, depth: commands::QUEUE },
        };
        self.source.subscribe(&spec, Arc::clone(&want.sink)).map_err(|why| match why {
            TransportError::NoSuchTopic { .. } => 1,
            why => {
                error!(topic = %visible(&want.name), error = &why as &dyn std::error::Error, "cannot hear commands");
                AGAIN
            }
        })
    }
}

/// Of what is there, the topic that is wanted: of the type that a manifest says, else of the one
/// that most write.
fn choose<'a>(
    topics: &'a [DiscoveredTopic],
    want: &Want,
    odd: &mut HashSet<String>,
) -> Option<&'a DiscoveredTopic> {
    let mut named = topics.iter().filter(|topic| topic.topic == want.name);
    let is_wanted = |found: &&DiscoveredTopic| {
        want.type_name.as_ref().is_none_or(|wanted| found.type_name == *wanted)
    };
    // The transport names first what most write.
    let found = named.clone().find(is_wanted);
    let chosen = found.map(|found| &found.type_name);
    if let Some(other) = named.find(|topic| Some(&topic.type_name) != chosen)
        && matches!(want.what, Wanted::Recorded { .. })
        && odd.insert(want.name.clone())
    {
        let (topic, other) = (visible(&want.name), visible(&other.type_name));
        match (chosen, &want.type_name) {
            (Some(chosen), _) => {
                warn!(%topic, recorded = %visible(chosen), %other, "a topic is written as several types, one is recorded");
            }
            (None, wanted) => {
                let wanted = wanted.as_deref().unwrap_or_default();
                warn!(%topic, %wanted, %other, "a topic is written as another type than the input says, not recorded so far");
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
        let said = |bytes| Largest::of(Some(bytes));
        assert_eq!(said(100).and(said(300)).and(said(200)).bytes(image), 300);
        assert_eq!(
            said(100).and(Largest::of(None)).bytes(image),
            32 << 20,
            "somebody does not know"
        );
        assert_eq!(Largest::of(None).and(said(64 << 20)).bytes(image), 64 << 20);
    }
}
