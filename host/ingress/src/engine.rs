//! The loop of the ingress: one thread that owns the source, the topics and the readers.

use std::os::fd::{AsFd, OwnedFd};
use std::time::{Duration, Instant};

use gleaner_buffers::shared::SharedLayout;
use gleaner_messages::transport::{
    DefinitionsSearch, DiscoveredTopic, Health, LiveSource, same_type,
};
use gleaner_protocol::ingress::{
    AddReader, AddTopics, AttachedTopic, IngressReport, IngressRequest, IngressServer,
    IngressStatus, ReaderMessage, RefusedTopic, RegionLayout, SourceStatus, TopicGrant,
};
use gleaner_protocol::link::{Incoming, LinkError};
use gleaner_protocol::process_stats::usage;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use tracing::{error, info, warn};

use crate::reader::{Attachment, ConnectedReader, DefinitionsWait};
use crate::topic::SharedTopic;
use crate::topics::TopicTable;

/// Interval of checks for what no descriptor announces: writers of a topic, definitions, the end of
/// a drive.
const TICK: Duration = Duration::from_millis(100);
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// Time that a reader waits for definitions at most.
const DEFINITIONS_TIMEOUT: Duration = Duration::from_secs(6);
/// Requests of a reader for the definitions of one topic that are answered by a search. A program
/// keeps what it is sent.
const SEARCHES: usize = 2;
/// Most readers at a time. Each has a socket and a control page.
const READERS: usize = 512;

/// Receives reports of the ingress. It must not block.
pub type Reports = Box<dyn FnMut(IngressReport) + Send>;

/// The ingress: shares the samples of one source with its readers.
pub struct Ingress {
    source: Box<dyn LiveSource>,
    reports: Reports,
    topics: TopicTable,
    readers: Vec<ConnectedReader>,
    /// Index of the reader whose definitions are searched first.
    first: usize,
    health: Health,
    /// True from the start of a drive to its end.
    plays: bool,
    status_at: Instant,
    tick_at: Instant,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LoopEnd {
    Stopped,
    StarterEnded,
}

impl Ingress {
    pub fn new(source: Box<dyn LiveSource>, reports: Reports) -> Self {
        let now = Instant::now();
        Self {
            health: source.health(),
            source,
            reports,
            topics: TopicTable::default(),
            readers: Vec::new(),
            first: 0,
            plays: false,
            status_at: now + STATUS_INTERVAL,
            tick_at: now + TICK,
        }
    }

    /// Serves readers until the starter sends stop or ends, or until `stop` is readable. Readers
    /// then see the end of their connections.
    ///
    /// # Errors
    ///
    /// Errors of waiting for sockets, which need a kernel without memory.
    pub fn run(mut self, control: IngressServer, stop: Option<OwnedFd>) -> std::io::Result<()> {
        if let Some(joined) = self.source.joined() {
            (self.reports)(IngressReport::Joined(joined));
        }
        (self.reports)(IngressReport::Ready);
        let mut control = control;
        let end = self.serve(&mut control, stop.as_ref())?;
        info!(reason = ?end, "ingress is shutting down");
        self.update_status(Instant::now());
        let status = self.status();
        (self.reports)(IngressReport::Ended(Box::new(status)));
        Ok(())
    }

    fn serve(
        &mut self,
        control: &mut IngressServer,
        stop: Option<&OwnedFd>,
    ) -> std::io::Result<LoopEnd> {
        loop {
            let now = Instant::now();
            self.tick(now);
            let ready = self.wait(control, stop, now)?;
            if ready.stop {
                return Ok(LoopEnd::Stopped);
            }
            // Before new readers: one that is restarted has the name of one that has ended.
            self.handle_readers(&ready.readers, Instant::now());
            if ready.control
                && let Some(end) = self.handle_control(control)
            {
                return Ok(end);
            }
        }
    }

    fn wait(
        &mut self,
        control: &IngressServer,
        stop: Option<&OwnedFd>,
        now: Instant,
    ) -> std::io::Result<Ready> {
        let mut timeout = self.tick_at.min(self.status_at).saturating_duration_since(now);
        let mut events = Vec::with_capacity(self.readers.len());
        for reader in &mut self.readers {
            let wait = reader.wait(now);
            // While it may make no request, only its end is of interest.
            let reads = if wait.is_zero() { PollFlags::IN } else { PollFlags::empty() };
            let writes = if reader.is_pending() { PollFlags::OUT } else { PollFlags::empty() };
            if reader.has_more() || !wait.is_zero() {
                timeout = timeout.min(wait);
            }
            events.push(reads | writes);
        }
        let mut polled = vec![PollFd::new(control, PollFlags::IN)];
        let with_events = self.readers.iter().zip(events);
        polled.extend(with_events.map(|(reader, events)| PollFd::new(reader, events)));
        polled.extend(stop.map(|stop| PollFd::new(stop, PollFlags::IN)));
        let timeout = Timespec {
            tv_sec: timeout.as_secs().try_into().unwrap_or(i64::MAX),
            tv_nsec: timeout.subsec_nanos().into(),
        };
        match poll(&mut polled, Some(&timeout)) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
        let mut found = polled.iter().map(PollFd::revents);
        Ok(Ready {
            control: found.next().is_some_and(|events| !events.is_empty()),
            readers: found.by_ref().take(self.readers.len()).collect(),
            stop: found.next().is_some_and(|events| !events.is_empty()),
        })
    }

    fn handle_readers(&mut self, ready: &[PollFlags], now: Instant) {
        for (index, events) in ready.iter().enumerate() {
            let reader = &mut self.readers[index];
            if events.contains(PollFlags::OUT) {
                reader.flush();
            }
            let ended = PollFlags::HUP | PollFlags::ERR;
            if !reader.wait(now).is_zero() {
                // What it published beyond its rate is lost with it.
                reader.is_gone |= events.intersects(ended);
            } else if reader.has_more() || events.intersects(ended | PollFlags::IN) {
                reader.handle_requests(now).into_iter().for_each(|it| self.answer(index, it, now));
            }
        }
        self.remove_gone();
    }

    fn handle_control(&mut self, control: &mut IngressServer) -> Option<LoopEnd> {
        loop {
            match control.poll() {
                Ok(Incoming::Message(IngressRequest::AddReader(add, socket))) => {
                    self.add_reader(&add, socket);
                }
                Ok(Incoming::Message(IngressRequest::AddTopics(add))) => self.add_topics(add),
                Ok(Incoming::Message(IngressRequest::Begin)) => {
                    self.plays = true;
                    self.source.begin();
                    self.tick_soon();
                }
                Ok(Incoming::Message(IngressRequest::Stop)) => return Some(LoopEnd::Stopped),
                Ok(Incoming::Nothing) => return None,
                Ok(Incoming::Ended) => return Some(LoopEnd::StarterEnded),
                Err(why @ (LinkError::Grant { .. } | LinkError::NoSocket { .. })) => {
                    let error = &why as &dyn std::error::Error;
                    error!(error, "refused request from parent process");
                }
                Err(why) => {
                    let error = &why as &dyn std::error::Error;
                    error!(error, "protocol error on the control connection");
                    return Some(LoopEnd::StarterEnded);
                }
            }
        }
    }

    fn add_reader(&mut self, add: &AddReader, socket: OwnedFd) {
        if self.readers.len() == READERS {
            error!(reader = add.name, most = READERS, "refused a reader: too many are connected");
            return;
        }
        if self.readers.iter().any(|reader| reader.name == add.name) {
            warn!(reader = add.name, "another reader of this name is connected; both are served");
        }
        match ConnectedReader::welcome(add, socket, &*self.source, Instant::now()) {
            Ok(reader) => self.readers.push(reader),
            Err(why) => {
                let error = &why as &dyn std::error::Error;
                error!(reader = add.name, error, "cannot serve a reader");
                return;
            }
        }
        self.grant(self.readers.len() - 1, &add.topics);
        self.remove_gone();
    }

    fn add_topics(&mut self, add: AddTopics) {
        match self.readers.iter().rposition(|reader| reader.name == add.reader) {
            Some(index) => self.grant(index, &add.topics),
            None => warn!(reader = add.reader, "ignored topics for a reader that has ended"),
        }
        self.remove_gone();
    }

    /// Attaches granted topics, as far as they are known.
    fn grant(&mut self, index: usize, grants: &[TopicGrant]) {
        let topics = self.source.topics();
        for grant in grants {
            let id = grant.id;
            let reader = &mut self.readers[index];
            let is_used = reader.topics.iter().any(|known| known.id == id)
                || reader.waiting.iter().any(|known| known.id == id);
            if is_used {
                let reason = vec![format!("id {id} is granted twice")];
                reader.refuse(id, RefusedTopic::Other(reason));
            } else if let Some(type_name) = &grant.type_name {
                let is_it = |topic: &&DiscoveredTopic| {
                    topic.topic == grant.topic && same_type(&topic.type_name, type_name)
                };
                let found = topics.iter().find(is_it);
                self.attach(index, grant, &type_name.clone(), found);
            } else if !self.attach_found(index, grant, &topics) {
                self.readers[index].waiting.push(grant.clone());
                self.tick_soon();
            }
        }
    }

    /// Attaches a topic with the type of its writers. Returns false if there is none yet.
    fn attach_found(
        &mut self,
        index: usize,
        grant: &TopicGrant,
        topics: &[DiscoveredTopic],
    ) -> bool {
        // The type with most writers comes first.
        if let Some(found) = topics.iter().find(|topic| topic.topic == grant.topic) {
            self.attach(index, grant, &found.type_name, Some(found));
            return true;
        }
        if !self.source.knows_all_topics() {
            return false;
        }
        let known: Vec<String> = topics.iter().map(|topic| topic.topic.clone()).collect();
        let nearest = gleaner_base::text::nearest(&grant.topic, known.iter().map(String::as_str));
        let nearest = nearest.map(str::to_owned);
        self.readers[index].refuse(grant.id, RefusedTopic::NoSuchTopic { known, nearest });
        true
    }

    /// Attaches a topic of a known type.
    fn attach(
        &mut self,
        index: usize,
        grant: &TopicGrant,
        type_name: &str,
        found: Option<&DiscoveredTopic>,
    ) {
        if let Err(reason) = self.try_attach(index, grant, type_name, found) {
            self.readers[index].refuse(grant.id, reason);
        }
    }

    fn try_attach(
        &mut self,
        index: usize,
        grant: &TopicGrant,
        type_name: &str,
        found: Option<&DiscoveredTopic>,
    ) -> Result<(), RefusedTopic> {
        let reader = &mut self.readers[index];
        let Some(limits) = reader.take_words(grant.holds) else {
            let why = "its holds, and those of the other topics, do not fit on the control page";
            return Err(RefusedTopic::Other(vec![why.to_owned()]));
        };
        let source = &mut *self.source;
        let attaching = self.topics.attach(source, grant, type_name, (&reader.control, limits));
        let (topic, attached) = match attaching {
            Ok(done) => done,
            Err(reason) => {
                reader.give_back(limits);
                return Err(reason);
            }
        };
        let before = self.topics.get(topic).map_or_else(Default::default, |it| it.status.clone());
        reader.topics.push(Attachment { id: grant.id, topic, attached, before, searches: 0 });
        let SharedLayout { depth, slots, slot_bytes } = attached.sizes.layout;
        let type_hash = self.topics.layout(&*self.source, topic);
        let current = found.filter(|found| found.type_hash == type_hash);
        let message = AttachedTopic {
            id: grant.id,
            type_name: found.map_or(type_name, |found| &found.type_name).to_owned(),
            layout: RegionLayout { depth, slots, slot_bytes },
            first_word: limits.first_word,
            holds: grant.holds,
            first: attached.first,
            digests: attached.digests,
            refused: attached.refused,
            definitions: current.and_then(|it| Some(it.definitions_text.as_ref()?.to_string())),
            type_hash,
            is_recorded: self.source.knows_all_topics(),
            offered_qos: found.and_then(|found| found.offered_qos.clone()),
        };
        let file = self.topics.file(topic, &attached).map(OwnedFd::as_fd);
        reader.send(&ReaderMessage::Attached(Box::new(message)), file);
        self.tick_soon();
        Ok(())
    }

    /// Detaches readers whose connections have ended: what they held is free.
    fn remove_gone(&mut self) {
        while let Some(index) = self.readers.iter().position(|reader| reader.is_gone) {
            // In order: of several readers with a name, the last one is the newest.
            let reader = self.readers.remove(index);
            for attachment in &reader.topics {
                self.topics.detach(&mut *self.source, attachment.topic, &attachment.attached);
            }
            info!(reader = reader.name, "a reader has disconnected");
        }
    }

    /// Answers a reader that lacks the layout of a topic, or its definitions, once they have come.
    fn answer(&mut self, index: usize, (id, is_layout): (u32, bool), now: Instant) {
        let reader = &mut self.readers[index];
        if is_layout {
            let key = reader.topics.iter().find(|known| known.id == id).map(|known| known.topic);
            let type_hash = key.and_then(|key| self.topics.layout(&*self.source, key));
            return reader.send(&ReaderMessage::Layout { id, type_hash }, None);
        }
        if reader.definitions.iter().any(|wait| wait.id == id) {
            return;
        }
        let topic = reader.topics.iter_mut().find(|known| known.id == id);
        let Some(topic) = topic.filter(|known| known.searches < SEARCHES) else {
            return reader.send(&ReaderMessage::Definitions { id, text: None }, None);
        };
        topic.searches += 1;
        reader.definitions.push(DefinitionsWait { id, until: now + DEFINITIONS_TIMEOUT });
        self.tick_soon();
    }

    /// Looks for what no descriptor announces, if it is time.
    fn tick(&mut self, now: Instant) {
        if now >= self.status_at {
            self.update_status(now);
            self.report_status(now);
        }
        if now < self.tick_at {
            return;
        }
        let waits =
            |reader: &ConnectedReader| !reader.waiting.is_empty() || !reader.definitions.is_empty();
        let some_wait = self.readers.iter().any(waits);
        if some_wait {
            let topics = self.source.topics();
            for index in 0..self.readers.len() {
                self.attach_waiting(index, &topics);
            }
            // There is one query at a time: the reader after the one that it was for is next.
            let (first, readers) = (self.first, self.readers.len());
            for index in (0..readers).map(|offset| (first + offset) % readers) {
                if self.answer_definitions(index, &topics, now) {
                    self.first = index + 1;
                }
            }
            self.remove_gone();
        }
        self.topics.take_over(&mut *self.source, now);
        if self.plays && self.source.has_ended() {
            self.plays = false;
            self.update_status(now);
            self.report_status(now);
            (self.reports)(IngressReport::DriveEnded);
        }
        let again = some_wait || self.plays || self.topics.has_two_subscriptions();
        self.tick_at = now + if again { TICK } else { STATUS_INTERVAL };
    }

    fn tick_soon(&mut self) {
        self.tick_at = self.tick_at.min(Instant::now() + TICK);
    }

    fn attach_waiting(&mut self, index: usize, topics: &[DiscoveredTopic]) {
        let waiting = std::mem::take(&mut self.readers[index].waiting);
        for grant in waiting {
            if !self.attach_found(index, &grant, topics) {
                self.readers[index].waiting.push(grant);
            }
        }
    }

    /// Answers requests for definitions that have come, or will not. Returns true if a query was
    /// sent for one of the others.
    fn answer_definitions(
        &mut self,
        index: usize,
        topics: &[DiscoveredTopic],
        now: Instant,
    ) -> bool {
        let mut has_started = false;
        let reader = &mut self.readers[index];
        for wait in std::mem::take(&mut reader.definitions) {
            let attached = reader.topics.iter().find(|known| known.id == wait.id);
            let topic = attached.and_then(|known| self.topics.get(known.topic));
            let text = topic.and_then(|topic| {
                let of_it = topics.iter().filter(|found| found.topic == topic.name());
                let mut same = of_it.filter(|found| same_type(&found.type_name, topic.type_name()));
                same.find_map(|found| found.definitions_text.clone())
            });
            let search = match topic {
                Some(topic) if text.is_none() && now < wait.until => {
                    self.source.search_definitions(topic.type_name())
                }
                _ => DefinitionsSearch::Ended,
            };
            has_started |= search == DefinitionsSearch::Started;
            if search == DefinitionsSearch::Ended {
                let text = text.map(|text| text.to_string());
                reader.send(&ReaderMessage::Definitions { id: wait.id, text }, None);
            } else {
                reader.definitions.push(wait);
            }
        }
        has_started
    }

    fn update_status(&mut self, now: Instant) {
        self.status_at = now + STATUS_INTERVAL;
        self.health = self.source.health();
        self.topics.update_status(&*self.source);
    }

    fn report_status(&mut self, now: Instant) {
        let mut health = self.health.clone();
        if self.source.knows_all_topics() {
            // A damaged drive ends early. Readers handle what it has delivered.
            health.dead = None;
        }
        for reader in &mut self.readers {
            let status = |known: &Attachment| {
                Some((known.id, known.reception(&self.topics.get(known.topic)?.status)))
            };
            let status = SourceStatus {
                health: health.clone(),
                topics: reader.topics.iter().filter_map(status).collect(),
                unsent: reader.unsent,
            };
            reader.send(&ReaderMessage::Status(Box::new(status)), None);
            reader.check_progress(now);
        }
        self.remove_gone();
        let status = self.status();
        (self.reports)(IngressReport::Status(Box::new(status)));
    }

    fn status(&self) -> IngressStatus {
        IngressStatus {
            health: self.health.clone(),
            topics: self.topics.all().map(SharedTopic::report).collect(),
            readers: self.readers.len(),
            rss_bytes: usage::resident(),
            cpu_s: usage::cpu_seconds(),
        }
    }
}

/// Events found by a wait.
struct Ready {
    control: bool,
    stop: bool,
    readers: Vec<PollFlags>,
}
