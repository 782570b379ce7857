//! Live topics of ROS 2 over DDS.
//!
//! [`Dds`] is one participant in a domain. One thread of this crate waits for all readers at once
//! and passes every sample to its sink. RustDDS has two more threads, one for the network and one
//! for discovery. A subscription with [`Qos::Auto`] requests what writers offer, as `ros2 bag
//! record` does: it has no reader until there is a writer.
//!
//! A sample is copied once: into the sink's memory, if the sink can copy before it gets the
//! sample's metadata. A packet filter in the kernel drops packets that would take more memory than
//! any subscription needs. The limits of RustDDS are listed in `docs/dds-limits.md`.
//!
//! Never here: a sink that does more than copy while a lock of RustDDS is held; parsing of
//! messages, other than those of the ROS 2 graph and type descriptions; a packet sent elsewhere
//! than RustDDS sends it, and none with other bytes, but for the hash that the end of a reader or a
//! writer lacks (`key_hash`).
//!
//! RustDDS does not expose bytes 2 and 3 of a sample's encapsulation (they are given as zeros). It
//! drops samples that are badly broken by itself; they show as lost.
//!
//! [`Qos::Auto`]: gleaner_messages::transport::Qos::Auto

mod announcer;
#[cfg(feature = "clap")]
mod arguments;
mod before_match;
mod bpf;
mod clock_watch;
mod definitions_cache;
mod discovery;
mod filter;
mod graph;
mod graph_message;
mod joins;
mod key_hash;
mod names;
mod nodes;
mod options;
mod packet_filter;
mod peers;
mod qos;
mod raw;
mod receive;
mod signal_mask;
mod sockets;
mod state;
mod topic_reader;
mod type_check;
mod type_query;
mod watchdog;
mod writer;

use std::collections::{BTreeMap, HashSet};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustdds::{DomainParticipant, DomainParticipantBuilder, RTPSEntity};
use tracing::{info, warn};

#[cfg(feature = "clap")]
pub use arguments::NetworkArgs;
pub use discovery::DomainTopic;
pub use options::{DdsError, DdsOptions, Distro};
pub use receive::MAX_MAPPED;
pub use writer::TopicWriter;

use announcer::{Announcements, Announcer};
use definitions_cache::DefinitionsCache;
use discovery::ListedTopic;
use gleaner_base::text::nearest;
use gleaner_messages::transport::{
    DefinitionsSearch, DiscoveredTopic, Health, LiveSource, PublishError, Publisher,
    ReceptionStatus, Sink, Subscription, TopicSpec, Transport, TransportError, same_type,
};
use gleaner_messages::{Definitions, Sources};
use gleaner_protocol::NetworkStatus;
use gleaner_protocol::ingress::JoinedParticipant;
use joins::NoJoin;
use packet_filter::PacketFilter;
use receive::{ReceiverCommand, ReceiverHandle};
use signal_mask::SignalMask;
use sockets::Sockets;
use state::{ParticipantState, SubscriptionStatus, lock};
use topic_reader::{TopicReader, kept};
use type_check::TopicLayout;
use watchdog::Watchdog;

/// The receive buffer of a socket has room for this many of the largest samples, up to
/// `MAX_BUFFER`.
const SAMPLES_IN_BUFFER: usize = 4;
const MAX_BUFFER: usize = 64 << 20;
/// The size that RustDDS requests by itself.
const MIN_BUFFER: usize = 8 << 20;
/// Time that the receive thread may take to end. A sink that holds a sample then is not waited for.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);

/// The threads that RustDDS starts: network and discovery.
const LIBRARY_THREADS: usize = 2;

/// Held while a participant is created, so that its threads can be identified.
static OPENING: Mutex<()> = Mutex::new(());

/// One participant in a domain, and its subscriptions.
pub struct Dds {
    participant: DomainParticipant,
    state: Arc<ParticipantState>,
    receiver: ReceiverHandle,
    thread: Option<JoinHandle<()>>,
    watchdog: Mutex<Watchdog>,
    domain: u16,
    joined: JoinedParticipant,
    buffer: (usize, usize),
    real_time: bool,
    /// Topic, type and status of each subscription, by its number.
    subscriptions: BTreeMap<usize, (TopicSpec, Arc<SubscriptionStatus>)>,
    /// Number of the next subscription.
    next: usize,
    definitions: Mutex<DefinitionsCache>,
}

impl Dds {
    /// Joins the domain.
    ///
    /// # Errors
    ///
    /// [`DdsError`] if it cannot be joined, or if the node's name is invalid.
    pub fn open(options: DdsOptions) -> Result<Self, DdsError> {
        let node = options.checked()?;
        let needed = options.largest.saturating_mul(SAMPLES_IN_BUFFER).min(MAX_BUFFER);
        let asked = needed.max(MIN_BUFFER);
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
        let signal_mask = SignalMask::block();
        let no_join = NoJoin::at(sockets::port_of_samples(options.domain));
        let announcements = Announcements::of(options.domain);
        let participant = builder.build().map_err(join)?;
        drop(no_join);
        drop(signal_mask);
        let made: HashSet<u32> = sockets::library_threads().difference(&before).copied().collect();
        // If there are more, another participant was created at the same time, and the threads of
        // this one cannot be identified.
        let threads = if made.len() == LIBRARY_THREADS { made } else { HashSet::new() };
        let sockets = Sockets::of(options.domain, participant.participant_id());
        drop(opening);
        let state = Arc::new(ParticipantState::default());
        let filter = PacketFilter::new(&sockets, peers::prefix(&participant.guid()), &state);
        let own = peers::prefix(&participant.guid());
        let announcer = Announcer::new(announcements, own, options.domain, &options.interfaces);
        let joined = JoinedParticipant {
            prefix: own,
            port: sockets::port_of_samples(options.domain) - 1,
            addresses: announcer.addresses(),
        };
        let (receiver, thread) =
            receive::start(&options, node, &participant, (filter, announcer), &state)?;
        info!(domain = options.domain, node = options.node, "joined");
        Ok(Self {
            participant,
            state,
            receiver,
            thread: Some(thread),
            watchdog: Mutex::new(Watchdog::new(sockets, threads)),
            domain: options.domain,
            joined,
            buffer: (asked, granted(asked, needed)),
            real_time: options.real_time,
            subscriptions: BTreeMap::new(),
            next: 0,
            definitions: Mutex::new(DefinitionsCache::new(Sources::new(
                &options.messages,
                &options.prefixes,
            ))),
        })
    }

    /// A writer of `topic`, reliable and volatile, that keeps its `depth` newest samples. Fails if
    /// a name is not valid in ROS 2.
    pub fn writer(
        &self,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<TopicWriter, DdsError> {
        TopicWriter::new(&self.participant, &self.state, &self.receiver, topic, type_name, depth)
    }

    /// Describes how other nodes see this participant in the ROS 2 graph.
    pub fn graph(&self) -> String {
        self.state.graph().0
    }

    /// The ROS 2 topics that other participants write or read, sorted by name; at most 4096.
    pub fn discovered(&self) -> Vec<DomainTopic> {
        let listed = discovery::topics(&self.participant, None, &[]);
        listed.into_iter().map(|listed| listed.shown).collect()
    }

    /// The hash (RIHS01) of the layout in which a topic is received: that of its subscription, else
    /// that of the definition at hand if writers announce it, else any that they announce. `None`
    /// if they announce none, as up to Humble.
    pub fn type_hash(&self, topic: &str) -> Option<String> {
        self.hash_as(topic, &self.type_of(topic).ok()?)
    }

    /// As [`type_hash`](Self::type_hash), of a topic that is received as this type.
    fn hash_as(&self, topic: &str, type_name: &str) -> Option<String> {
        let listed = discovery::topics(&self.participant, None, &[]);
        let is_it =
            |shown: &DomainTopic| shown.topic == topic && same_type(&shown.type_name, type_name);
        let found = listed.into_iter().find(|listed| is_it(&listed.shown));
        let announced = found.map(|listed| listed.type_hashes).unwrap_or_default();
        self.layout_of(topic, type_name, &announced, &mut lock(&self.definitions))
    }

    /// The layout to which a subscription of a topic is fixed.
    fn fixed_layout(&self, topic: &str, type_name: &str) -> Option<&str> {
        let is_it = |spec: &TopicSpec| spec.topic == topic && same_type(&spec.type_name, type_name);
        let mut subscribed = self.subscriptions.values().filter(|(spec, _)| is_it(spec));
        subscribed.find_map(|(_, status)| status.layout.get())
    }

    fn layout_of(
        &self,
        topic: &str,
        type_name: &str,
        announced: &[String],
        definitions: &mut DefinitionsCache,
    ) -> Option<String> {
        if let Some(fixed) = self.fixed_layout(topic, type_name) {
            return Some(fixed.to_owned());
        }
        let at_hand = definitions.hash_at_hand(type_name);
        TopicLayout::choose(at_hand.as_deref(), announced.iter().map(String::as_str))
            .map(str::to_owned)
    }

    /// The type of a topic: as it is subscribed, else as others write or read it.
    fn type_of(&self, topic: &str) -> Result<String, TransportError> {
        if let Some((spec, _)) = self.subscriptions.values().find(|(spec, _)| spec.topic == topic) {
            return Ok(spec.type_name.clone());
        }
        let known = self.discovered();
        // The first has the most writers; another participant may only read it as another type.
        if let Some(found) = known.iter().find(|found| found.topic == topic) {
            return Ok(found.type_name.clone());
        }
        let known: Vec<String> = known.into_iter().map(|found| found.topic).collect();
        let nearest = nearest(topic, known.iter().map(String::as_str)).map(str::to_owned);
        Err(TransportError::NoSuchTopic { topic: topic.to_owned(), known, nearest })
    }
}

/// Returns the bytes of `asked` that the kernel grants; logs a warning if that is less than
/// `needed`.
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
        let in_dds = |(spec, _): &(TopicSpec, Arc<SubscriptionStatus>)| {
            Some((names::dds_topic(&spec.topic)?, names::dds_type(&spec.type_name)?))
        };
        let subscribed: Vec<_> = self.subscriptions.values().filter_map(in_dds).collect();
        let topics = discovery::topics(&self.participant, self.state.graph().1, &subscribed);
        let discovered = |ListedTopic { shown, offered_qos, type_hashes }| {
            let DomainTopic { topic, type_name, .. } = shown;
            let mut definitions = lock(&self.definitions);
            let layout = self.layout_of(&topic, &type_name, &type_hashes, &mut definitions);
            DiscoveredTopic {
                definitions_text: definitions.text(&type_name, layout.as_deref()),
                type_hash: layout,
                topic,
                type_name,
                offered_qos,
                ..DiscoveredTopic::default()
            }
        };
        // A topic that is only read delivers nothing, and its readers may have another type.
        topics.into_iter().filter(|found| found.shown.writers > 0).map(discovered).collect()
    }

    /// As for every transport, but a topic without a writer can be subscribed. Names that are not
    /// valid in ROS 2 are [`TransportError::NoSuchTopic`] and [`TransportError::NoDefinitions`].
    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        let at_hand = lock(&self.definitions).hash_at_hand(&spec.type_name);
        let layout = TopicLayout::new(at_hand);
        // That of an earlier subscription, else one that writers announce.
        if let Some(fixed) = self.hash_as(&spec.topic, &spec.type_name) {
            layout.fix(&fixed);
        }
        let status = Arc::new(SubscriptionStatus { layout, ..SubscriptionStatus::default() });
        let index = self.next;
        let Some(reader) = TopicReader::new(index, spec, sink, status.clone()) else {
            let (topic, type_name) = (names::visible(&spec.topic), names::visible(&spec.type_name));
            return Err(match names::dds_topic(&spec.topic) {
                Some(_) => TransportError::NoDefinitions { topic, type_name },
                None => TransportError::NoSuchTopic { topic, known: Vec::new(), nearest: None },
            });
        };
        self.receiver.send(ReceiverCommand::Subscribe(Box::new(reader)));
        self.subscriptions.insert(index, (spec.clone(), status));
        self.next += 1;
        Ok(Subscription(index))
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        let type_name = self.type_of(topic)?;
        let bad = |source| TransportError::BadDefinitions { topic: topic.to_owned(), source };
        let layout = self.type_hash(topic);
        let known = lock(&self.definitions).parsed(&type_name, layout.as_deref()).map_err(bad)?;
        known.ok_or_else(|| TransportError::NoDefinitions { topic: topic.to_owned(), type_name })
    }

    /// Requests the definitions from a node that writes the type: one query at a time, and at most
    /// three for a type. While it has no writer, there is none.
    fn search_definitions(&self, type_name: &str) -> DefinitionsSearch {
        let mut definitions = lock(&self.definitions);
        definitions.search(type_name, &self.participant, &self.receiver, &self.state)
    }

    fn status(&self, subscription: Subscription) -> ReceptionStatus {
        self.subscriptions
            .get(&subscription.0)
            .map(|(_, status)| status.status(&self.state))
            .unwrap_or_default()
    }
}

impl LiveSource for Dds {
    /// A dead participant is detected after ten calls.
    fn health(&self) -> Health {
        let topic = |index: usize| self.subscriptions.get(&index).map(|(spec, _)| &*spec.topic);
        let (queues, dead) = lock(&self.watchdog).check(&self.state, topic);
        let ended = self.thread.as_ref().is_none_or(JoinHandle::is_finished);
        let network = NetworkStatus {
            domain: self.domain,
            participants: self.state.peers().participants(),
            buffer_requested: self.buffer.0,
            buffer_granted: self.buffer.1,
            real_time: self.real_time,
            // The kernel counts these for all programs in the network namespace together. If
            // buffers of other programs were full as well, some of the drops counted here were in
            // fact filtered.
            socket_drops: queues.drops,
            filtered: queues.filtered,
            unfiltered: self.state.unfiltered(),
        };
        let dead = dead.or_else(|| ended.then(|| "the receive thread has ended".to_owned()));
        Health { network: Some(network), dead }
    }

    fn joined(&self) -> Option<JoinedParticipant> {
        Some(self.joined.clone())
    }

    /// RustDDS keeps more than is asked for, so that few subscriptions need another reader.
    fn suffices(&self, spec: &TopicSpec, wanted: &TopicSpec) -> bool {
        let deeper = TopicSpec { queue: spec.queue.max(wanted.queue), ..spec.clone() };
        wanted.max_bytes <= spec.max_bytes && kept(&deeper) <= kept(spec)
    }

    fn layout(&self, subscription: Subscription) -> Option<String> {
        self.subscriptions.get(&subscription.0)?.1.layout.get().map(str::to_owned)
    }

    /// The reader, its entry in the graph and its status are gone as soon as the receive thread
    /// handles the command. RustDDS keeps the newest samples of the topic for a later subscription.
    fn unsubscribe(&mut self, subscription: Subscription) {
        if let Some((_, status)) = self.subscriptions.remove(&subscription.0) {
            status.ended.store(true, Ordering::Relaxed);
            self.receiver.send(ReceiverCommand::Unsubscribe(subscription.0));
        }
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

impl Publisher for TopicWriter {
    fn publish(&self, cdr: &[u8]) -> Result<(), PublishError> {
        self.write(cdr).map_err(|error| PublishError(error.into()))
    }
}

impl Drop for Dds {
    fn drop(&mut self) {
        self.receiver.send(ReceiverCommand::Stop);
        let Some(thread) = self.thread.take() else { return };
        let begun = Instant::now();
        while !thread.is_finished() {
            if begun.elapsed() > STOP_TIMEOUT {
                warn!("receive thread did not stop in time; detached");
                return;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        // The cause, if it died, was logged at that time.
        drop(thread.join());
    }
}
