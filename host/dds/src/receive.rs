//! The receive thread: polls all readers, delivers their samples, and follows the offers of
//! writers.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::hint::black_box;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::mpsc;
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use mio::{Events, Interest, Poll, Token, Waker};
use rustdds::discovery::DiscoveredWriterData;
use rustdds::{
    DomainParticipant, DomainParticipantStatusEvent, DomainParticipantStatusListener, GUID,
    StatusEvented,
};

use super::announcer::Announcer;
use super::clock_watch::ClockWatch;
use super::graph::GraphNode;
use super::packet_filter::PacketFilter;
use super::qos::Offer;
use super::state::{ParticipantState, panic_text};
use super::topic_reader::{self, ReceiveContext, TopicReader};
use super::type_query::{TypeQuerier, TypeQuery};
use super::{DdsError, DdsOptions, discovery};
use gleaner_messages::transport::Clock;

const WAKE: Token = Token(0);
const STATUS: Token = Token(1);
const GRAPH: Token = Token(2);
const ANSWER: Token = Token(3);

/// Most samples of one topic before the next one's turn.
const MAX_PER_TURN: usize = 64;
/// Shortest time between two updates after changes, and longest time without an update.
const UPDATE_MIN: Duration = Duration::from_millis(100);
const UPDATE_MAX: Duration = Duration::from_secs(1);
/// Shared memory for samples that is always kept.
const SHARED_BYTES: usize = 1 << 20;
/// Most memory that is mapped before there are samples, for all topics together, in bytes.
pub const MAX_MAPPED: usize = 256 << 20;
/// Size of the blocks in which it is mapped: the allocator keeps blocks of this size, and merges
/// them.
const MAPPED_BLOCK: usize = 1 << 20;

pub(super) enum ReceiverCommand {
    Subscribe(Box<TopicReader>),
    Unsubscribe(usize),
    Writer(GUID),
    WriterGone(GUID),
    Query(TypeQuery),
    Stop,
}

#[derive(Clone)]
pub(super) struct ReceiverHandle {
    commands: mpsc::Sender<ReceiverCommand>,
    waker: Arc<Waker>,
}

impl ReceiverHandle {
    /// Sends a command. Without effect if the thread has ended, which `Health` reports.
    pub(super) fn send(&self, command: ReceiverCommand) {
        if self.commands.send(command).is_ok() {
            drop(self.waker.wake());
        }
    }
}

struct Receiver {
    poll: Poll,
    commands: mpsc::Receiver<ReceiverCommand>,
    participant: DomainParticipant,
    listener: DomainParticipantStatusListener,
    /// Subscriptions, by their number.
    readers: BTreeMap<usize, TopicReader>,
    writers: Vec<GUID>,
    graph: GraphNode,
    querier: TypeQuerier,
    filter: PacketFilter,
    announcer: Announcer,
    state: Arc<ParticipantState>,
    memory: RefCell<Vec<u8>>,
    clock: Clock,
    clock_watch: ClockWatch,
    /// Bytes of the largest sample in [`DdsOptions::largest`], whatever is subscribed so far.
    largest: usize,
    /// True if memory is mapped before there are samples.
    real_time: bool,
    /// Bytes of that memory.
    mapped: usize,
    /// True if something changed since the last update.
    changed: bool,
    updated: Option<Instant>,
}

pub(super) fn start(
    options: &DdsOptions,
    node: (String, String),
    participant: &DomainParticipant,
    (filter, announcer): (PacketFilter, Announcer),
    state: &Arc<ParticipantState>,
) -> Result<(ReceiverHandle, JoinHandle<()>), DdsError> {
    let join = |source: io::Error| DdsError::Join { domain: options.domain, source: source.into() };
    let poll = Poll::new().map_err(join)?;
    let waker = Arc::new(Waker::new(poll.registry(), WAKE).map_err(join)?);
    let mut listener = participant.status_listener();
    poll.registry().register(&mut listener, STATUS, Interest::READABLE).map_err(join)?;
    let graph = GraphNode::new(options, node, participant, poll.registry(), GRAPH)?;
    let (commands, receiver) = mpsc::channel();
    let receiver = Receiver {
        poll,
        commands: receiver,
        participant: participant.clone(),
        listener,
        readers: BTreeMap::new(),
        writers: Vec::new(),
        graph,
        querier: TypeQuerier::default(),
        filter,
        announcer,
        state: state.clone(),
        memory: RefCell::new(Vec::with_capacity(SHARED_BYTES)),
        clock: options.clock,
        clock_watch: ClockWatch::new(options.time_of_day),
        largest: options.largest,
        real_time: options.real_time,
        mapped: 0,
        changed: true,
        updated: None,
    };
    let state = state.clone();
    let body = move || {
        if let Err(panic) = catch_unwind(AssertUnwindSafe(|| receiver.run())) {
            state.die(format!("the receive thread panicked: {}", panic_text(&*panic)));
        }
    };
    let thread = Builder::new().name("gleaner receive".to_owned()).spawn(body).map_err(join)?;
    Ok((ReceiverHandle { commands, waker }, thread))
}

impl Receiver {
    fn run(mut self) {
        let mut events = Events::with_capacity(256);
        loop {
            match self.poll.poll(&mut events, Some(self.poll_timeout())) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => {
                    return self.state.die(format!("the receive thread cannot poll: {error}"));
                }
                Ok(()) => {}
            }
            for event in &events {
                match event.token() {
                    WAKE => self.changed = true,
                    STATUS => self.note_events(),
                    GRAPH | ANSWER => self.changed = true,
                    token => {
                        if let Some(reader) = topic_reader::index(token)
                            .and_then(|index| self.readers.get_mut(&index))
                        {
                            reader.ready = true;
                        }
                    }
                }
            }
            if !self.handle_commands() {
                break;
            }
            self.take();
            self.announcer.poll();
            if self.due() {
                self.update();
            }
        }
        let Self { participant, graph, readers, .. } = self;
        graph.leave(&participant);
        drop(readers);
    }

    fn due(&self) -> bool {
        let since = self.updated.map(|updated| updated.elapsed());
        since.is_none_or(|since| since >= UPDATE_MAX || self.changed && since >= UPDATE_MIN)
    }

    /// Time until the next update is due.
    fn poll_timeout(&self) -> Duration {
        if self.readers.values().any(|reader| reader.ready) {
            return Duration::ZERO;
        }
        let every = if self.changed { UPDATE_MIN } else { UPDATE_MAX };
        let update =
            self.updated.map_or(Duration::ZERO, |updated| every.saturating_sub(updated.elapsed()));
        self.announcer.until_due(Instant::now()).map_or(update, |due| update.min(due))
    }

    fn handle_commands(&mut self) -> bool {
        while let Ok(command) = self.commands.try_recv() {
            match command {
                ReceiverCommand::Subscribe(reader) => {
                    self.readers.insert(reader.index(), *reader);
                    self.map_memory();
                    // Its reader is created at once, not at the next change in the domain.
                    self.updated = None;
                }
                ReceiverCommand::Unsubscribe(index) => {
                    if let Some(mut reader) = self.readers.remove(&index) {
                        reader.remove_reader(self.poll.registry(), &self.state);
                    }
                }
                ReceiverCommand::Writer(guid) => self.writers.push(guid),
                ReceiverCommand::WriterGone(guid) => self.writers.retain(|writer| *writer != guid),
                ReceiverCommand::Query(query) => self.querier.start(query),
                ReceiverCommand::Stop => return false,
            }
            self.changed = true;
        }
        true
    }

    /// Maps memory for the samples of all readers, if there is less, and frees it for the allocator
    /// to reuse: a page is new to the process only once.
    fn map_memory(&mut self) {
        let each = self.readers.values().map(TopicReader::memory_needed);
        let needed = each.fold(0, usize::saturating_add).min(MAX_MAPPED);
        if self.real_time && needed > self.mapped {
            self.mapped = needed;
            // At once, since memory that is freed between would be mapped again and again. Zeros
            // alone would not be written.
            let blocks = (0..needed.div_ceil(MAPPED_BLOCK)).map(|_| vec![1_u8; MAPPED_BLOCK]);
            drop(black_box(blocks.collect::<Vec<_>>()));
        }
    }

    fn note_events(&mut self) {
        while let Some(event) = self.listener.try_recv_status() {
            self.changed |= self.state.peers().note(&event);
            if matches!(event, DomainParticipantStatusEvent::ParticipantDiscovered { .. }) {
                self.announcer.restart();
            }
            self.state.handled.fetch_add(1, Relaxed);
        }
    }

    /// Removes matches with endpoints that are gone.
    fn keep_matches(&self, writers: &[DiscoveredWriterData]) {
        let present = writers.iter().map(|writer| writer.writer_proxy.remote_writer_guid).collect();
        self.state.peers().keep(|own| own.entity_id.kind().is_reader(), &present);
        if !self.writers.is_empty() {
            let readers = self.participant.discovered_readers();
            let present =
                readers.iter().map(|reader| reader.reader_proxy.remote_reader_guid).collect();
            self.state.peers().keep(|own| self.writers.contains(own), &present);
        }
    }

    fn take(&mut self) {
        let context = ReceiveContext {
            participant: &self.participant,
            registry: self.poll.registry(),
            state: &self.state,
            memory: &self.memory,
            clock: self.clock,
        };
        for reader in self.readers.values_mut().filter(|reader| reader.ready) {
            reader.take(&context, MAX_PER_TURN);
        }
    }

    fn update(&mut self) {
        self.changed = false;
        self.updated = Some(Instant::now());
        if let Some(back) = self.clock_watch.set_back() {
            let seconds = (back + 500_000_000) / 1_000_000_000;
            self.state.die(format!(
                "the time of day was set back by {seconds} s: until it catches up, no samples \
                 of best-effort writers and no new participants are received; restart the process"
            ));
        }
        // Before the writers are read: see `Peers::keep`.
        self.note_events();
        let writers = self.participant.discovered_writers();
        self.keep_matches(&writers);
        let offers: Vec<Offer> = writers.iter().map(discovery::offer).collect();
        self.note_events();
        let largest = self.readers.values().map(TopicReader::largest).max().unwrap_or(0);
        let largest = largest.max(self.largest).max(self.querier.largest());
        // Before readers are created: fragments of the first sample have to pass. Each participant
        // is announced once; a known writer stands in for a participant that was missed.
        let mut others = self.state.peers().prefixes();
        others.extend(
            offers.iter().map(|offer| *offer.guid.0.first_chunk::<12>().expect("12 of 16 bytes")),
        );
        others.sort_unstable();
        others.dedup();
        self.filter.update(largest, &others, &self.state);
        let context = ReceiveContext {
            participant: &self.participant,
            registry: self.poll.registry(),
            state: &self.state,
            memory: &self.memory,
            clock: self.clock,
        };
        for reader in self.readers.values_mut() {
            reader.update(&context, &offers);
            // RustDDS stops at a change that is not a sample, such as a writer's leave; samples
            // after it are found here.
            reader.ready = true;
        }
        // Register new participants before reading their graph messages.
        self.graph.nodes().keep(&others);
        self.graph.receive(&context);
        self.querier.poll(&context, ANSWER, &offers, self.graph.nodes());
        // An open query is polled again soon.
        self.changed |= self.querier.is_open();
        let readers = self.readers.values().filter_map(TopicReader::guid).collect();
        self.graph.update(&context, readers, &self.writers);
        // One unexpectedly large sample must not keep its memory for ever.
        let mut memory = self.memory.borrow_mut();
        memory.clear();
        memory.shrink_to(largest.max(SHARED_BYTES));
    }
}
