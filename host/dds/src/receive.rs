//! The receive thread: waits for all readers at once, hands over what came, and looks at who offers
//! what.

use std::cell::RefCell;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::mpsc;
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use mio::{Events, Interest, Poll, Token, Waker};
use rustdds::{DomainParticipant, DomainParticipantStatusListener, GUID, StatusEvented};

use super::ask::{Ask, Asker};
use super::day::Day;
use super::feed::{self, Around, Feed};
use super::guard::Guard;
use super::offers::Offer;
use super::presence::Presence;
use super::state::{State, panic_text};
use super::{DdsError, Options, wire};
use gleaner_transport::Clock;

const WAKE: Token = Token(0);
const STATUS: Token = Token(1);
const GRAPH: Token = Token(2);
const ANSWER: Token = Token(3);

/// Samples of one topic before it is the next one's turn.
const TURN: usize = 64;
/// How often it is looked who offers what: after something changed, and in any case.
const SOON: Duration = Duration::from_millis(100);
const ANYWAY: Duration = Duration::from_secs(1);
/// Memory for samples that is kept, however small they are.
const KEPT_BYTES: usize = 1 << 20;

/// What the receive thread is asked to do.
pub(super) enum Command {
    Subscribe(Box<Feed>),
    Writer(GUID),
    WriterGone(GUID),
    Ask(Ask),
    Stop,
}

/// The way to the receive thread.
#[derive(Clone)]
pub(super) struct Line {
    commands: mpsc::Sender<Command>,
    waker: Arc<Waker>,
}

impl Line {
    /// Tells the thread. If it has ended, nobody is told; `Health` says so.
    pub(super) fn send(&self, command: Command) {
        if self.commands.send(command).is_ok() {
            drop(self.waker.wake());
        }
    }
}

struct Receiver {
    poll: Poll,
    commands: mpsc::Receiver<Command>,
    participant: DomainParticipant,
    listener: DomainParticipantStatusListener,
    feeds: Vec<Feed>,
    writers: Vec<GUID>,
    presence: Presence,
    asker: Asker,
    guard: Guard,
    state: Arc<State>,
    memory: RefCell<Vec<u8>>,
    clock: Clock,
    day: Day,
    /// Bytes of the largest sample that was announced, whatever is subscribed so far.
    largest: usize,
    /// Something changed since the last look.
    changed: bool,
    looked: Option<Instant>,
}

/// Starts the thread.
pub(super) fn start(
    options: &Options,
    node: (String, String),
    participant: &DomainParticipant,
    guard: Guard,
    state: &Arc<State>,
) -> Result<(Line, JoinHandle<()>), DdsError> {
    let join = |source: io::Error| DdsError::Join { domain: options.domain, source: source.into() };
    let poll = Poll::new().map_err(join)?;
    let waker = Arc::new(Waker::new(poll.registry(), WAKE).map_err(join)?);
    let mut listener = participant.status_listener();
    poll.registry().register(&mut listener, STATUS, Interest::READABLE).map_err(join)?;
    let presence = Presence::new(options, node, participant, poll.registry(), GRAPH)?;
    let (commands, receiver) = mpsc::channel();
    let receiver = Receiver {
        poll,
        commands: receiver,
        participant: participant.clone(),
        listener,
        feeds: Vec::new(),
        writers: Vec::new(),
        presence,
        asker: Asker::default(),
        guard,
        state: state.clone(),
        memory: RefCell::new(Vec::with_capacity(KEPT_BYTES)),
        clock: options.clock,
        day: Day::new(options.time_of_day),
        largest: options.largest,
        changed: true,
        looked: None,
    };
    let state = state.clone();
    let body = move || {
        if let Err(panic) = catch_unwind(AssertUnwindSafe(|| receiver.run())) {
            state.die(format!("the receive thread panicked: {}", panic_text(&*panic)));
        }
    };
    let thread = Builder::new().name("gleaner receive".to_owned()).spawn(body).map_err(join)?;
    Ok((Line { commands, waker }, thread))
}

impl Receiver {
    fn run(mut self) {
        let mut events = Events::with_capacity(256);
        loop {
            match self.poll.poll(&mut events, Some(self.patience())) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => {
                    return self.state.die(format!("the receive thread cannot wait: {error}"));
                }
                Ok(()) => {}
            }
            for event in &events {
                match event.token() {
                    WAKE => self.changed = true,
                    STATUS => self.note_events(),
                    GRAPH | ANSWER => self.changed = true,
                    token => {
                        if let Some(feed) =
                            feed::index(token).and_then(|index| self.feeds.get_mut(index))
                        {
                            feed.ready = true;
                        }
                    }
                }
            }
            if !self.obey() {
                break;
            }
            self.take();
            if self.due() {
                self.look();
            }
        }
        let Self { participant, presence, feeds, .. } = self;
        presence.leave(&participant);
        drop(feeds);
    }

    fn due(&self) -> bool {
        let since = self.looked.map(|looked| looked.elapsed());
        since.is_none_or(|since| since >= ANYWAY || self.changed && since >= SOON)
    }

    /// How long nothing needs to be done.
    fn patience(&self) -> Duration {
        if self.feeds.iter().any(|feed| feed.ready) {
            return Duration::ZERO;
        }
        let every = if self.changed { SOON } else { ANYWAY };
        self.looked.map_or(Duration::ZERO, |looked| every.saturating_sub(looked.elapsed()))
    }

    fn obey(&mut self) -> bool {
        while let Ok(command) = self.commands.try_recv() {
            match command {
                Command::Subscribe(feed) => {
                    self.feeds.push(*feed);
                    // A reader at once, not when somebody else happens to change something.
                    self.looked = None;
                }
                Command::Writer(guid) => self.writers.push(guid),
                Command::WriterGone(guid) => self.writers.retain(|writer| *writer != guid),
                Command::Ask(ask) => self.asker.ask(ask),
                Command::Stop => return false,
            }
            self.changed = true;
        }
        true
    }

    fn note_events(&mut self) {
        while let Some(event) = self.listener.try_recv_status() {
            self.changed |= self.state.peers().note(&event);
            self.state.handled.fetch_add(1, Relaxed);
        }
    }

    fn take(&mut self) {
        let around = Around {
            participant: &self.participant,
            registry: self.poll.registry(),
            state: &self.state,
            memory: &self.memory,
            clock: self.clock,
        };
        for feed in self.feeds.iter_mut().filter(|feed| feed.ready) {
            feed.take(&around, TURN);
        }
    }

    fn look(&mut self) {
        self.changed = false;
        self.looked = Some(Instant::now());
        if let Some(back) = self.day.set_back() {
            let seconds = (back + 500_000_000) / 1_000_000_000;
            self.state.die(format!(
                "the time of day was set back by {seconds} s: until it has caught up, nothing of best-effort writers is heard, \
                 and no participant that is new; a restart cures that"
            ));
        }
        let writers = self.participant.discovered_writers();
        let offers: Vec<Offer> = writers.iter().map(wire::offer).collect();
        self.note_events();
        let largest = self.feeds.iter().map(Feed::largest).max().unwrap_or(0);
        let largest = largest.max(self.largest).max(self.asker.largest());
        // Before there are readers: fragments of the first sample have to pass. Participants are
        // told of once; a writer that is known speaks for one that was missed.
        let mut others = self.state.peers().prefixes();
        others.extend(
            offers.iter().map(|offer| *offer.guid.0.first_chunk::<12>().expect("12 of 16 bytes")),
        );
        others.sort_unstable();
        others.dedup();
        self.guard.update(largest, &others, &self.state);
        let around = Around {
            participant: &self.participant,
            registry: self.poll.registry(),
            state: &self.state,
            memory: &self.memory,
            clock: self.clock,
        };
        for feed in &mut self.feeds {
            feed.look(&around, &offers);
            // RustDDS stops at what is no sample, a writer's leave for instance; what is behind it
            // is found here.
            feed.ready = true;
        }
        // What those say who come from now on is heard below, and kept.
        self.presence.nodes().keep(&others);
        self.presence.listen(&around);
        self.asker.look(&around, ANSWER, &writers, self.presence.nodes());
        // What it waits for is looked at soon.
        self.changed |= self.asker.is_asking();
        let readers = self.feeds.iter().filter_map(Feed::guid).collect();
        self.presence.speak(&around, readers, &self.writers);
        // One sample of a size that nobody expected shall not be remembered for ever.
        let mut memory = self.memory.borrow_mut();
        memory.clear();
        memory.shrink_to(largest.max(KEPT_BYTES));
    }
}
