//! Live topics of ROS 2 over DDS.
//!
//! [`Dds`] is one participant in a domain. One thread of ours waits for all readers at once and
//! hands every sample to its sink; RustDDS has two threads more, one for the network and one for
//! discovery. A subscription with [`Qos::Auto`] asks for what writers offer, as `ros2 bag record`
//! does: it has no reader until there is a writer.
//!
//! A sample is copied once: into the sink's memory, if the sink can do so before it knows whose
//! sample it is. The kernel keeps packets away that would take more memory than anybody subscribed
//! to. What RustDDS cannot do is told in `docs/dds-limits.md`.
//!
//! What never happens here: a sink that does more than to copy under a lock of RustDDS; a message
//! being understood, apart from those of ROS 2's graph and the answers of nodes that are asked for
//! definitions; a packet sent elsewhere than RustDDS sends it.
//!
//! What RustDDS does not tell: bytes 2 and 3 of a sample's encapsulation, given as zeros, and
//! samples that are so broken that it drops them itself, which show as lost.
//!
//! [`Qos::Auto`]: gleaner_transport::Qos::Auto

#[cfg(feature = "clap")]
mod arguments;
mod ask;
mod bpf;
mod day;
mod feed;
mod filter;
mod graph;
mod guard;
mod joins;
mod known;
mod names;
mod nodes;
mod offers;
mod options;
mod peers;
mod presence;
mod raw;
mod receive;
mod shield;
mod sockets;
mod state;
mod types;
mod watch;
mod wire;
mod writer;

use std::collections::HashSet;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustdds::{DomainParticipant, DomainParticipantBuilder, RTPSEntity};
use tracing::{info, warn};

#[cfg(feature = "clap")]
pub use arguments::NetworkArgs;
pub use options::{DdsError, Distro, Options};
pub use wire::TopicOnWire;
pub use writer::Writer;

use feed::Feed;
use gleaner_base::words::nearest;
use gleaner_messages::{Definitions, Sources};
use gleaner_protocol::Network;
use gleaner_transport::{
    DiscoveredTopic, Health, LiveSource, PublishError, Publisher, Sink, Status, Subscription,
    TopicSpec, Transport, TransportError,
};
use guard::Guard;
use joins::NoJoin;
use known::Known;
use receive::{Command, Line};
use shield::Shield;
use sockets::Sockets;
use state::{State, Told, lock};
use watch::Watch;

/// The receive buffer of a socket is to hold four of the largest samples, as far as that is
/// sensible.
const SAMPLES_IN_BUFFER: usize = 4;
const MOST_BUFFER: usize = 64 << 20;
/// What RustDDS asks for by itself.
const LEAST_BUFFER: usize = 8 << 20;
/// How long the receive thread may take to end. A sink that has a sample then is not waited for.
const LAST_WORDS: Duration = Duration::from_secs(5);

/// The network's and the discovery's.
const LIBRARY_THREADS: usize = 2;

/// Held while a participant is made, so that it is known which threads are its own.
static OPENING: Mutex<()> = Mutex::new(());

/// One participant in a domain, and its subscriptions.
pub struct Dds {
    participant: DomainParticipant,
    state: Arc<State>,
    line: Line,
    thread: Option<JoinHandle<()>>,
    watch: Mutex<Watch>,
    domain: u16,
    buffer: (usize, usize),
    /// Topic, type and status of each subscription.
    subscriptions: Vec<(TopicSpec, Arc<Told>)>,
    known: Mutex<Known>,
}

impl Dds {
    /// Joins the domain.
    ///
    /// # Errors
    ///
    /// [`DdsError`] if it cannot be joined, or if the node's name is none.
    pub fn open(options: Options) -> Result<Self, DdsError> {
        let node = options.checked()?;
        let needed = options.largest.saturating_mul(SAMPLES_IN_BUFFER).min(MOST_BUFFER);
        let asked = needed.max(LEAST_BUFFER);
        let opening = OPENING.lock().unwrap_or_else(PoisonError::into_inner);
        let before = sockets::library_threads();
        let mut builder =
            DomainParticipantBuilder::new(options.domain).socket_receive_buffer_size(asked);
        if !options.interfaces.is_empty() {
            builder = builder.with_only_networks(options.interfaces.iter().copied());
        }
        let join = |error: rustdds::dds::CreateError| DdsError::Join {
            domain: options.domain,
            source: error.into(),
        };
        let shield = Shield::up();
        let no_join = NoJoin::at(sockets::port_of_samples(options.domain));
        let participant = builder.build().map_err(join)?;
        drop(no_join);
        drop(shield);
        let made: HashSet<u32> = sockets::library_threads().difference(&before).copied().collect();
        // If there are more, somebody else made a participant at the same time, and which are ours
        // is not known.
        let threads = if made.len() == LIBRARY_THREADS { made } else { HashSet::new() };
        let sockets = Sockets::of(options.domain, participant.participant_id());
        drop(opening);
        let state = Arc::new(State::default());
        let guard = Guard::new(&sockets, peers::prefix(&participant.guid()), &state);
        let (line, thread) = receive::start(&options, node, &participant, guard, &state)?;
        info!(domain = options.domain, node = options.node, "joined");
        Ok(Self {
            participant,
            state,
            line,
            thread: Some(thread),
            watch: Mutex::new(Watch::new(sockets, threads)),
            domain: options.domain,
            buffer: (asked, granted(asked, needed)),
            subscriptions: Vec::new(),
            known: Mutex::new(Known::new(Sources::new(&options.messages, &options.prefixes))),
        })
    }

    /// A writer of `topic`, reliable and volatile, that keeps its `depth` newest samples.
    ///
    /// # Errors
    ///
    /// [`DdsError`] if a name is no name in ROS.
    pub fn writer(&self, topic: &str, type_name: &str, depth: usize) -> Result<Writer, DdsError> {
        Writer::new(&self.participant, &self.state, &self.line, topic, type_name, depth)
    }

    /// Returns how others see this participant in the graph of ROS 2, in words.
    pub fn graph(&self) -> String {
        self.state.graph().0
    }

    /// The topics of ROS 2 that others write or read, sorted by name; at most 4096.
    pub fn discovered(&self) -> Vec<TopicOnWire> {
        wire::topics(&self.participant, None).into_iter().map(|(topic, _)| topic).collect()
    }

    /// The type of a topic: as it is subscribed, else as others write or read it.
    fn type_of(&self, topic: &str) -> Result<String, TransportError> {
        if let Some((spec, _)) = self.subscriptions.iter().find(|(spec, _)| spec.topic == topic) {
            return Ok(spec.type_name.clone());
        }
        let known = self.discovered();
        // The first is the one that most write; somebody may only read it as something else.
        if let Some(found) = known.iter().find(|found| found.topic == topic) {
            return Ok(found.type_name.clone());
        }
        let known: Vec<String> = known.into_iter().map(|found| found.topic).collect();
        let nearest = nearest(topic, known.iter().map(String::as_str)).map(str::to_owned);
        Err(TransportError::NoSuchTopic { topic: topic.to_owned(), known, nearest })
    }
}

/// What of `asked` the kernel grants; says so if that is less than `needed`.
fn granted(asked: usize, needed: usize) -> usize {
    let granted = sockets::granted(asked).unwrap_or(0);
    if granted < needed {
        let help = format!("sysctl -w net.core.rmem_max={needed}");
        warn!(
            needed,
            granted, help, "the kernel grants less socket buffer than large samples need"
        );
    }
    granted
}

impl Transport for Dds {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        let topics = wire::topics(&self.participant, self.state.graph().1);
        let discovered = |(found, offered_qos): (TopicOnWire, Option<String>)| DiscoveredTopic {
            definitions_text: lock(&self.known).text(&found.type_name),
            topic: found.topic,
            type_name: found.type_name,
            messages: None,
            offered_qos,
        };
        // What somebody only wants to read brings nothing, and may be of another type.
        topics.into_iter().filter(|(found, _)| found.writers > 0).map(discovered).collect()
    }

    /// As for every transport, but a topic that nobody writes yet can be subscribed. Names that ROS
    /// 2 does not have are [`TransportError::NoSuchTopic`] and [`TransportError::NoDefinitions`].
    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        let told = Arc::new(Told::default());
        let index = self.subscriptions.len();
        let Some(feed) = Feed::new(index, spec, sink, told.clone()) else {
            let (topic, type_name) = (names::visible(&spec.topic), names::visible(&spec.type_name));
            return Err(match names::dds_topic(&spec.topic) {
                Some(_) => TransportError::NoDefinitions { topic, type_name },
                None => TransportError::NoSuchTopic { topic, known: Vec::new(), nearest: None },
            });
        };
        self.line.send(Command::Subscribe(Box::new(feed)));
        self.subscriptions.push((spec.clone(), told));
        Ok(Subscription(index))
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        let type_name = self.type_of(topic)?;
        let bad = |source| TransportError::BadDefinitions { topic: topic.to_owned(), source };
        let known = lock(&self.known).parsed(&type_name).map_err(bad)?;
        known.ok_or_else(|| TransportError::NoDefinitions { topic: topic.to_owned(), type_name })
    }

    /// Asks the node that writes the topic, as far as one question at a time and three for a type
    /// allow.
    fn definitions_may_come(&self, topic: &str) -> bool {
        let type_name = self.type_of(topic);
        type_name
            .is_ok_and(|type_name| lock(&self.known).may_come(&type_name, &self.line, &self.state))
    }

    fn status(&self, subscription: Subscription) -> Status {
        self.subscriptions
            .get(subscription.0)
            .map(|(_, told)| told.status(&self.state))
            .unwrap_or_default()
    }
}

impl LiveSource for Dds {
    /// What is dead is known after ten calls.
    fn health(&self) -> Health {
        let topics: Vec<String> =
            self.subscriptions.iter().map(|(spec, _)| spec.topic.clone()).collect();
        let (queues, dead) = lock(&self.watch).look(&self.state, &topics);
        let ended = self.thread.as_ref().is_none_or(JoinHandle::is_finished);
        let network = Network {
            domain: self.domain,
            participants: self.state.peers().participants(),
            buffer_asked: self.buffer.0,
            buffer_granted: self.buffer.1,
            // The kernel counts those for all programs of the network together, so if buffers of
            // others were full as well, some that count here were filtered.
            socket_drops: queues.drops,
            filtered: queues.filtered,
            unfiltered: self.state.unfiltered(),
        };
        let dead = dead.or_else(|| ended.then(|| "the receive thread has ended".to_owned()));
        Health { network: Some(network), dead }
    }

    fn publisher(
        &self,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<Box<dyn Publisher>, PublishError> {
        let writer =
            self.writer(topic, type_name, depth).map_err(|error| PublishError(error.into()))?;
        Ok(Box::new(writer))
    }
}

impl Publisher for Writer {
    fn publish(&self, cdr: &[u8]) -> Result<(), PublishError> {
        self.write(cdr).map_err(|error| PublishError(error.into()))
    }
}

impl Drop for Dds {
    fn drop(&mut self) {
        self.line.send(Command::Stop);
        let Some(thread) = self.thread.take() else { return };
        let begun = Instant::now();
        while !thread.is_finished() {
            if begun.elapsed() > LAST_WORDS {
                warn!("a sink keeps the receive thread; it is left behind");
                return;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        // What it died of, if it did, was said when it died.
        drop(thread.join());
    }
}
