//! The connection of this process to the ingress.

use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::{Duration, Instant};

use gleaner_base::chain;
use gleaner_buffers::shared::SharedReader;
use gleaner_messages::transport::{PublishError, Publisher};
use gleaner_protocol::ingress::{
    IngressLink, IngressRequests, ReaderDelivery, ReaderMessage, RefusedTopic, SourceStatus,
};
use gleaner_protocol::link::Incoming;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::topic::{AttachError, OwnPage};
use crate::{FeedError, SharedTopicReader, Waker};

/// Time to wait for the first message: the ingress may start at the same time, and join a network
/// or open a long drive.
const WELCOME_TIMEOUT: Duration = Duration::from_secs(60);

/// Interval at which a wait tries to send the rest of a request.
const WAIT_STEP: Duration = Duration::from_millis(100);

/// Messages that one call reads at most: the rest follows in the next call.
const MESSAGES_MAX: usize = 4096;

#[derive(Debug)]
pub enum FeedEvent {
    /// A granted topic can be read.
    Attached(SharedTopicReader),
    /// A granted topic cannot be read.
    Refused {
        /// Its id, from the grant.
        id: u32,
        reason: RefusedTopic,
    },
    /// The answer to [`Feed::request_definitions`].
    Definitions {
        id: u32,
        /// ros2msg text of its type and of all types it refers to; `None` if there is none.
        text: Option<String>,
    },
    /// The answer to [`Feed::request_layout`].
    Layout {
        id: u32,
        /// Hash (RIHS01) of the layout that is received; `None` if no writer has announced one.
        type_hash: Option<String>,
    },
}

/// A connection to an ingress that may not have started yet.
pub(crate) struct JoiningFeed {
    link: IngressLink,
    requests: IngressRequests,
}

/// The samples of an attached topic, from a first position on.
#[derive(Clone)]
pub(crate) struct TopicMemory {
    pub(crate) reader: SharedReader,
    pub(crate) first: u64,
}

/// The connection of this process to the ingress.
///
/// It ends when the feed and all its publishers are dropped. Topics and held samples stay valid
/// after it, also when the ingress ends; there are no new samples then.
pub struct Feed {
    link: IngressLink,
    requests: IngressRequests,
    page: OwnPage,
    status: SourceStatus,
    attached: Vec<(u32, TopicMemory)>,
    /// Events that no call has returned yet.
    events: VecDeque<FeedEvent>,
    end: Option<FeedError>,
}

impl JoiningFeed {
    pub(crate) fn new(socket: OwnedFd) -> JoiningFeed {
        let (link, requests) = IngressLink::new(socket);
        JoiningFeed { link, requests }
    }

    /// Returns the connection if the ingress has sent its first message. Never waits.
    pub(crate) fn poll(mut self) -> Result<ControlFlow<Feed, JoiningFeed>, FeedError> {
        let delivery = match self.link.poll()? {
            Incoming::Message(delivery) => delivery,
            Incoming::Ended => return Err(FeedError::Gone),
            Incoming::Nothing => return Ok(ControlFlow::Continue(self)),
        };
        let ReaderDelivery { message: ReaderMessage::Welcome, descriptor: Some(page) } = delivery
        else {
            return Err(FeedError::malformed("the first one must open the connection"));
        };
        Ok(ControlFlow::Break(Feed {
            page: OwnPage::open(page)?,
            link: self.link,
            requests: self.requests,
            status: SourceStatus::default(),
            attached: Vec::new(),
            events: VecDeque::new(),
            end: None,
        }))
    }
}

impl Feed {
    /// Connects over the socket that the starter passed, and waits for the ingress, up to 60 s.
    ///
    /// # Errors
    ///
    /// [`FeedError::Gone`], [`FeedError::Silent`] or [`FeedError::Control`]; any other if the
    /// ingress breaks the rules.
    pub fn connect(socket: OwnedFd) -> Result<Feed, FeedError> {
        Feed::connect_within(socket, WELCOME_TIMEOUT)
    }

    fn connect_within(socket: OwnedFd, timeout: Duration) -> Result<Feed, FeedError> {
        let mut joining = JoiningFeed::new(socket);
        let until = Instant::now().checked_add(timeout);
        loop {
            joining = match joining.poll()? {
                ControlFlow::Break(feed) => return Ok(feed),
                ControlFlow::Continue(joining) => joining,
            };
            if is_over(until) {
                let (awaited, seconds) = ("a first message".to_owned(), timeout.as_secs());
                return Err(FeedError::Silent { awaited, seconds });
            }
            wait(joining.link.as_fd(), until);
        }
    }

    /// Waits until the topic with this `id` is attached. Events of other topics stay for
    /// [`poll`](Self::poll).
    ///
    /// # Errors
    ///
    /// [`FeedError::Refused`] if it cannot be read, [`FeedError::Silent`] after `timeout`; those of
    /// [`poll`](Self::poll).
    pub fn topic(&mut self, id: u32, timeout: Duration) -> Result<SharedTopicReader, FeedError> {
        let awaited = |event: &FeedEvent| match event {
            FeedEvent::Attached(topic) => topic.info.id == id,
            FeedEvent::Refused { id: refused, .. } => *refused == id,
            FeedEvent::Definitions { .. } | FeedEvent::Layout { .. } => false,
        };
        match self.wait_for(awaited, timeout, || format!("topic {id}"))? {
            FeedEvent::Attached(topic) => Ok(topic),
            FeedEvent::Refused { id, reason } => Err(FeedError::refused(id, reason)),
            FeedEvent::Definitions { .. } | FeedEvent::Layout { .. } => {
                unreachable!("the event is one of the topic")
            }
        }
    }

    /// Returns the events since the last call. Never waits.
    ///
    /// Call it about once a second: the ingress disconnects a process that does not read.
    ///
    /// # Errors
    ///
    /// [`FeedError::Gone`] once the ingress has ended, [`FeedError::Malformed`] or
    /// [`FeedError::Socket`] if it breaks the rules. Nothing arrives after an error.
    pub fn poll(&mut self) -> Result<Vec<FeedEvent>, FeedError> {
        self.read();
        if self.events.is_empty() {
            self.check_end()?;
        }
        Ok(self.events.drain(..).collect())
    }

    /// Requests the definitions of a topic, and waits for them; `None` if there are none.
    ///
    /// # Errors
    ///
    /// [`FeedError::Silent`] after `timeout`; those of [`poll`](Self::poll).
    pub fn definitions(&mut self, id: u32, timeout: Duration) -> Result<Option<String>, FeedError> {
        self.request_definitions(id)?;
        let awaited = |event: &FeedEvent| match event {
            FeedEvent::Definitions { id: found, .. } => *found == id,
            _ => false,
        };
        match self.wait_for(awaited, timeout, || format!("the definitions of topic {id}"))? {
            FeedEvent::Definitions { text, .. } => Ok(text),
            _ => unreachable!("the event has definitions"),
        }
    }

    /// Requests the definitions of a topic from the nodes that write it. The answer is an event,
    /// after some seconds at most. Never waits.
    ///
    /// # Errors
    ///
    /// [`FeedError::Gone`] once the ingress has ended, [`FeedError::Socket`] if it does not read.
    pub fn request_definitions(&mut self, id: u32) -> Result<(), FeedError> {
        Ok(self.requests.need_definitions(id)?)
    }

    /// Requests the layout that the writers of a topic announce, and waits for it; `None` if there
    /// is none.
    ///
    /// # Errors
    ///
    /// [`FeedError::Silent`] after `timeout`; those of [`poll`](Self::poll).
    pub fn layout(&mut self, id: u32, timeout: Duration) -> Result<Option<String>, FeedError> {
        self.request_layout(id)?;
        let awaited = |event: &FeedEvent| match event {
            FeedEvent::Layout { id: found, .. } => *found == id,
            _ => false,
        };
        match self.wait_for(awaited, timeout, || format!("the layout of topic {id}"))? {
            FeedEvent::Layout { type_hash, .. } => Ok(type_hash),
            _ => unreachable!("the event has a layout"),
        }
    }

    /// Requests the layout that the writers of a topic announce. The answer is an event. Never
    /// waits. Fails as [`request_definitions`](Self::request_definitions).
    pub fn request_layout(&mut self, id: u32) -> Result<(), FeedError> {
        Ok(self.requests.need_layout(id)?)
    }

    /// Returns the newest state of the source, as of the last [`poll`](Self::poll).
    pub fn status(&self) -> &SourceStatus {
        &self.status
    }

    pub(crate) fn attached(&self) -> &[(u32, TopicMemory)] {
        &self.attached
    }

    /// Returns the bell that the ingress rings.
    pub fn bell(&self) -> Waker {
        Waker::of(&self.page.control)
    }

    /// Returns a publisher of the topic that is number `index` among those that the starter lets
    /// this process publish. It never waits: a message is refused if the ingress does not keep up.
    pub fn publisher(&self, index: u32) -> Box<dyn Publisher> {
        Box::new(FeedPublisher { requests: self.requests.clone(), index })
    }

    fn wait_for(
        &mut self,
        is_awaited: impl Fn(&FeedEvent) -> bool,
        timeout: Duration,
        name: impl Fn() -> String,
    ) -> Result<FeedEvent, FeedError> {
        let until = Instant::now().checked_add(timeout);
        loop {
            self.read();
            if let Some(index) = self.events.iter().position(&is_awaited)
                && let Some(event) = self.events.remove(index)
            {
                return Ok(event);
            }
            self.check_end()?;
            if is_over(until) {
                let (awaited, seconds) = (name(), timeout.as_secs());
                return Err(FeedError::Silent { awaited, seconds });
            }
            wait(self.as_fd(), until);
        }
    }

    /// Returns the error that ended the connection, in full once.
    fn check_end(&mut self) -> Result<(), FeedError> {
        let Some(error) = self.end.take() else { return Ok(()) };
        self.end = Some(FeedError::Gone);
        Err(error)
    }

    fn read(&mut self) {
        // If it fails because the ingress has ended, its last messages may still be there.
        let _ = self.requests.flush();
        for _ in 0..MESSAGES_MAX {
            if self.end.is_some() {
                return;
            }
            let received = match self.link.poll() {
                Ok(Incoming::Message(delivery)) => self.receive(delivery),
                Ok(Incoming::Nothing) => return,
                Ok(Incoming::Ended) => Err(FeedError::Gone),
                Err(error) => Err(error.into()),
            };
            self.end = received.err();
        }
    }

    fn receive(&mut self, delivery: ReaderDelivery) -> Result<(), FeedError> {
        let event = match (delivery.message, delivery.descriptor) {
            (ReaderMessage::Attached(info), Some(file)) => {
                let id = info.id;
                match self.page.attach(*info, file) {
                    Ok(topic) => {
                        let (reader, first) = (topic.reader.clone(), topic.info.first);
                        self.attached.push((id, TopicMemory { reader, first }));
                        FeedEvent::Attached(topic)
                    }
                    Err(AttachError::Malformed(error)) => return Err(error),
                    // Other topics may fit.
                    Err(AttachError::Memory(error)) => {
                        let failed = "cannot map the memory of the topic".to_owned();
                        let reason = RefusedTopic::Other(vec![failed, chain(&error)]);
                        FeedEvent::Refused { id, reason }
                    }
                }
            }
            (ReaderMessage::Refused { id, reason }, _) => FeedEvent::Refused { id, reason },
            (ReaderMessage::Definitions { id, text }, _) => FeedEvent::Definitions { id, text },
            (ReaderMessage::Layout { id, type_hash }, _) => FeedEvent::Layout { id, type_hash },
            (ReaderMessage::Status(status), _) => {
                self.status = *status;
                return Ok(());
            }
            (ReaderMessage::Welcome | ReaderMessage::Attached(_), _) => {
                return Err(FeedError::malformed("it opens the connection again"));
            }
        };
        self.events.push_back(event);
        Ok(())
    }
}

/// A topic that this process may publish. The ingress drops what exceeds its grant.
struct FeedPublisher {
    requests: IngressRequests,
    /// Index of the topic among those that the starter lets this process publish.
    index: u32,
}

impl Publisher for FeedPublisher {
    fn publish(&self, cdr: &[u8]) -> Result<(), PublishError> {
        let sent = self.requests.publish(self.index, cdr);
        sent.map_err(|error| PublishError(Box::new(error)))
    }
}

impl AsFd for Feed {
    /// The socket, which is readable when [`Feed::poll`] has something to read.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.link.as_fd()
    }
}

fn is_over(until: Option<Instant>) -> bool {
    until.is_some_and(|until| Instant::now() >= until)
}

/// Waits until a message arrives, until the deadline, or for a short time.
fn wait(socket: BorrowedFd<'_>, until: Option<Instant>) {
    let left = until.map_or(WAIT_STEP, |until| until.saturating_duration_since(Instant::now()));
    // A step is far below the largest time of the system.
    let timeout = Timespec::try_from(left.min(WAIT_STEP)).ok();
    // Errors end the wait; the next look at the socket reports them.
    let _ = poll(&mut [PollFd::from_borrowed_fd(socket, PollFlags::IN)], timeout.as_ref());
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixStream;

    use super::*;

    #[test]
    fn a_silent_ingress_is_a_timeout_and_an_ended_one_is_gone() {
        let (ingress_end, reader_end) = UnixStream::pair().unwrap();
        let silent = Feed::connect_within(reader_end.into(), Duration::from_millis(20));
        let silent = silent.err().unwrap().to_string();
        assert_eq!(silent, "the ingress has not sent a first message for 0 s");
        drop(ingress_end);
        let (ingress_end, reader_end) = UnixStream::pair().unwrap();
        drop(ingress_end);
        assert!(matches!(Feed::connect(reader_end.into()), Err(FeedError::Gone)));
    }
}
