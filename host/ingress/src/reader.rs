//! A connected reader: its socket, its control page, and what it was granted.

use std::fs::File;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::{Duration, Instant};

use gleaner_buffers::shared::{HAZARDS, PinLimits};
use gleaner_messages::transport::{LiveSource, PublishError, Publisher};
use gleaner_protocol::ingress::{
    AddReader, PinGrant, PublishGrant, ReaderLink, ReaderMessage, ReaderRequest, ReceptionStatus,
    RefusedTopic, TopicGrant,
};
use gleaner_protocol::link::{Incoming, LinkError};
use gleaner_samples::regions::ControlRegion;
use tracing::warn;

use crate::publish_rate::PublishRate;
use crate::sink::AttachedReader;

/// Requests of a reader that are handled before others have their turn.
const TURN: usize = 64;

/// Time after which a reader is disconnected that reads none of the messages that wait for it.
const STALLED: Duration = Duration::from_secs(30);

/// A topic of a reader.
pub(crate) struct Attachment {
    pub(crate) id: u32,
    /// Key in the table of topics.
    pub(crate) topic: u64,
    pub(crate) attached: AttachedReader,
    /// State of the subscription when the reader was attached.
    pub(crate) before: ReceptionStatus,
    /// Number of requests for its definitions that were or will be answered by a search.
    pub(crate) searches: usize,
}

impl Attachment {
    /// Returns the state of the subscription for this reader: without what was missing before it.
    pub(crate) fn reception(&self, status: &ReceptionStatus) -> ReceptionStatus {
        let since = |all: Option<u64>, before: Option<u64>| {
            all.map(|all| all.saturating_sub(before.unwrap_or(0)))
        };
        let mut status = status.clone();
        status.lost = since(status.lost, self.before.lost);
        status.before_match = since(status.before_match, self.before.before_match);
        status.malformed = status.malformed.saturating_sub(self.before.malformed);
        status
    }
}

pub(crate) struct DefinitionsWait {
    pub(crate) id: u32,
    pub(crate) until: Instant,
}

struct PublishedTopic {
    /// `None` if the source refused it.
    publisher: Option<Box<dyn Publisher>>,
    max_bytes: usize,
}

pub(crate) struct ConnectedReader {
    pub(crate) name: String,
    link: ReaderLink,
    pub(crate) control: ControlRegion,
    /// Number of hazard words that are given out.
    words: u32,
    pub(crate) topics: Vec<Attachment>,
    /// Grants that wait for a writer, whose type they take.
    pub(crate) waiting: Vec<TopicGrant>,
    pub(crate) definitions: Vec<DefinitionsWait>,
    publishers: Vec<PublishedTopic>,
    /// Number of bytes that were sent when it last read, or when nothing waited, and that time.
    progress: (u64, Instant),
    rate: PublishRate,
    /// True if requests may have been received that are not handled yet.
    has_more: bool,
    /// Number of messages that were not published.
    pub(crate) unsent: u64,
    /// Set once the connection has ended, or has to.
    pub(crate) is_gone: bool,
}

impl ConnectedReader {
    /// Welcomes a reader, and opens the topics that it may publish.
    pub(crate) fn welcome(
        add: &AddReader,
        socket: OwnedFd,
        source: &dyn LiveSource,
        now: Instant,
    ) -> io::Result<Self> {
        let (control, page) = ControlRegion::create()?;
        let mut reader = Self {
            name: add.name.clone(),
            link: ReaderLink::new(socket),
            control,
            words: 0,
            topics: Vec::new(),
            waiting: Vec::new(),
            definitions: Vec::new(),
            publishers: add.publishes.iter().map(|grant| open(&add.name, grant, source)).collect(),
            progress: (0, now),
            rate: PublishRate::new(now),
            has_more: false,
            unsent: 0,
            is_gone: false,
        };
        reader.send(&ReaderMessage::Welcome, Some(File::as_fd(&page)));
        Ok(reader)
    }

    /// Gives out the hazard words of a topic; `None` if the control page lacks so many.
    pub(crate) fn take_words(&mut self, holds: PinGrant) -> Option<PinLimits> {
        let PinGrant { windows, window, singles } = holds;
        let end = self.words + u32::from(windows) + u32::from(singles);
        if end as usize > HAZARDS {
            return None;
        }
        let first_word = std::mem::replace(&mut self.words, end);
        Some(PinLimits { first_word, windows, window, singles })
    }

    /// Gives back the last words that were given out.
    pub(crate) fn give_back(&mut self, limits: PinLimits) {
        self.words = limits.first_word;
    }

    /// Sends a message. A reader for which too many messages wait is disconnected.
    pub(crate) fn send(&mut self, message: &ReaderMessage, descriptor: Option<BorrowedFd<'_>>) {
        if self.is_gone {
            return;
        }
        match self.link.send(message, descriptor) {
            Ok(()) => {}
            Err(LinkError::TooLong { .. }) => self.send_shortened(message, descriptor),
            Err(error) => self.disconnect(&error),
        }
    }

    /// Sends a message without the part that makes it too long: definitions, or a list of topics.
    fn send_shortened(&mut self, message: &ReaderMessage, descriptor: Option<BorrowedFd<'_>>) {
        warn!(reader = self.name, "message to a reader too long: sent without its longest part");
        let mut message = message.clone();
        match &mut message {
            ReaderMessage::Attached(topic) => topic.definitions = None,
            ReaderMessage::Definitions { text, .. } => *text = None,
            ReaderMessage::Refused { reason: RefusedTopic::NoSuchTopic { known, .. }, .. } => {
                known.clear();
            }
            ReaderMessage::Refused { reason, .. } => *reason = RefusedTopic::Other(Vec::new()),
            ReaderMessage::Status(status) => status.topics.clear(),
            ReaderMessage::Welcome | ReaderMessage::Layout { .. } => {}
        }
        if let Err(error) = self.link.send(&message, descriptor) {
            self.disconnect(&error);
        }
    }

    pub(crate) fn refuse(&mut self, id: u32, reason: RefusedTopic) {
        self.send(&ReaderMessage::Refused { id, reason }, None);
    }

    pub(crate) fn flush(&mut self) {
        if let Err(error) = self.link.flush() {
            self.disconnect(&error);
        }
    }

    /// Disconnects a reader that has read nothing for long while messages wait for it.
    pub(crate) fn check_progress(&mut self, now: Instant) {
        let sent = self.link.sent_bytes();
        if !self.is_pending() || sent != self.progress.0 {
            self.progress = (sent, now);
        } else if now.saturating_duration_since(self.progress.1) >= STALLED {
            self.disconnect(&LinkError::Full { peer: "the reader" });
        }
    }

    pub(crate) fn is_pending(&self) -> bool {
        self.link.is_pending()
    }

    /// Returns the time until a request may be read: 0 for now.
    pub(crate) fn wait(&mut self, now: Instant) -> Duration {
        self.rate.wait(now)
    }

    /// Returns whether there are requests that were received before.
    pub(crate) fn has_more(&self) -> bool {
        self.has_more
    }

    /// Handles some requests; returns the ids of topics whose definitions, or if set, whose layout
    /// is requested. Published messages are passed to the source.
    pub(crate) fn handle_requests(&mut self, now: Instant) -> Vec<(u32, bool)> {
        let mut definitions = Vec::new();
        self.has_more = true;
        for _ in 0..TURN {
            if self.is_gone || self.rate.wait(now) > Duration::ZERO {
                break;
            }
            let found = self.link.poll();
            let bytes = self.link.take_received();
            // A part of a request counts as one: it takes a turn of the loop, too.
            if bytes > 0 || matches!(found, Ok(Incoming::Message(_))) {
                self.rate.count(bytes);
            }
            match found {
                Ok(Incoming::Message(ReaderRequest::NeedDefinitions { id })) => {
                    definitions.push((id, false));
                }
                Ok(Incoming::Message(ReaderRequest::NeedLayout { id })) => {
                    definitions.push((id, true));
                }
                Ok(Incoming::Message(ReaderRequest::Publish { index, cdr })) => {
                    self.publish(index, &cdr);
                }
                Ok(Incoming::Nothing) => {
                    self.has_more = false;
                    break;
                }
                Ok(Incoming::Ended) => self.is_gone = true,
                Err(error) => self.disconnect(&error),
            }
        }
        definitions
    }

    fn publish(&mut self, index: u32, cdr: &[u8]) {
        let Some(topic) = self.publishers.get(index as usize) else {
            warn!(reader = self.name, index, "disconnected a reader: it may not publish a topic");
            self.is_gone = true;
            return;
        };
        let published = match &topic.publisher {
            // That was logged.
            None => {
                self.unsent += 1;
                return;
            }
            Some(_) if cdr.len() > topic.max_bytes => {
                let (bytes, most) = (cdr.len(), topic.max_bytes);
                Err(PublishError(format!("it has {bytes} bytes, more than {most}").into()))
            }
            Some(publisher) => publisher.publish(cdr),
        };
        if let Err(error) = published {
            if self.unsent == 0 {
                let (reader, error) = (&self.name, &error as &dyn std::error::Error);
                warn!(reader, error, "cannot publish a message; further failures are only counted");
            }
            self.unsent += 1;
        }
    }

    fn disconnect(&mut self, error: &LinkError) {
        if !std::mem::replace(&mut self.is_gone, true) && !matches!(error, LinkError::Gone { .. }) {
            let error = error as &dyn std::error::Error;
            warn!(reader = self.name, error, "disconnected a reader");
        }
    }
}

impl AsFd for ConnectedReader {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.link.as_fd()
    }
}

fn open(reader: &str, grant: &PublishGrant, source: &dyn LiveSource) -> PublishedTopic {
    let opened = source.publisher(&grant.topic, &grant.type_name, grant.depth);
    if let Err(error) = &opened {
        let (topic, error) = (&grant.topic, error as &dyn std::error::Error);
        warn!(reader, topic, error, "cannot publish a topic; its messages are dropped and counted");
    }
    PublishedTopic { publisher: opened.ok(), max_bytes: grant.max_bytes }
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::os::unix::net::UnixStream;

    use gleaner_messages::transport::loopback::Loopback;

    use super::*;

    #[test]
    fn a_reader_that_reads_nothing_is_disconnected_and_a_slow_one_is_not() {
        let (mut socket, end) = UnixStream::pair().unwrap();
        socket.set_nonblocking(true).unwrap();
        let start = Instant::now();
        let name = "slow".to_owned();
        let add = AddReader { name, topics: Vec::new(), publishes: Vec::new() };
        let mut reader =
            ConnectedReader::welcome(&add, end.into(), &Loopback::new(), start).unwrap();
        let send_until_pending = |reader: &mut ConnectedReader| {
            while !reader.is_pending() {
                assert!(!reader.is_gone);
                let known = vec!["/topic".to_owned(); 10_000];
                reader.refuse(1, RefusedTopic::NoSuchTopic { known, nearest: None });
            }
        };
        let mut now = start;
        for _ in 0..5 {
            send_until_pending(&mut reader);
            reader.check_progress(now);
            now += Duration::from_secs(29);
            reader.check_progress(now);
            while socket.read(&mut [0; 4096]).is_ok_and(|read| read > 0) {}
            reader.flush();
        }
        assert!(!reader.is_gone);
        send_until_pending(&mut reader);
        reader.check_progress(now);
        reader.check_progress(now + Duration::from_secs(30));
        assert!(reader.is_gone);
    }
}
