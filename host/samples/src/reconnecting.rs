//! The connection to the ingress over its restarts.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::os::fd::OwnedFd;
use std::time::{Duration, Instant};

use gleaner_buffers::shared::SharedReader;
use gleaner_messages::transport::Publisher;
use gleaner_protocol::ReceptionGaps;
use gleaner_protocol::ingress::{ReceptionStatus, SourceStatus};

use crate::feed::{JoiningFeed, TopicMemory};
use crate::losses::TopicLosses;
use crate::starter::StarterSocket;
use crate::{Feed, FeedError, FeedEvent, SharedTopicReader, Waker};

/// Time without an ingress after which the connection ends: twice the longest delay before a
/// restart.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Time in which an ingress that works answers.
const LAYOUT_TIMEOUT: Duration = Duration::from_secs(1);

/// The connection of this process to the ingress, and after a restart of the ingress to the next
/// one.
///
/// While there is no ingress, the samples in its memory stay valid, and no call fails. The starter
/// passes a connection to the next one; then each topic is attached again, in other memory.
pub struct ReconnectingReader {
    feed: Feed,
    /// `None` if the connection ends with the ingress.
    starter: Option<StarterSocket>,
    topics: BTreeMap<u32, LastingTopic>,
    gap: Option<OpenGap>,
    gaps: ReceptionGaps,
    /// Time at which the ingress was last seen.
    polled: Instant,
    /// Messages that earlier ingresses did not publish.
    unsent: u64,
    connections: u32,
}

struct LastingTopic {
    attached: TopicMemory,
    losses: TopicLosses,
}

struct OpenGap {
    since: Instant,
    until: Instant,
    /// Each topic, and the number of its samples when the end of the ingress was noticed.
    heads: Vec<(SharedReader, u64)>,
    joining: Option<JoiningFeed>,
}

impl ReconnectingReader {
    /// Continues with a connection. `starter` is the socket over which the starter passes
    /// connections to later ingresses.
    pub fn new(feed: Feed, starter: Option<OwnedFd>) -> ReconnectingReader {
        let topics = feed.attached().iter().map(|(id, attached)| {
            let (attached, losses) = (attached.clone(), TopicLosses::default());
            (*id, LastingTopic { attached, losses })
        });
        ReconnectingReader {
            topics: topics.collect(),
            feed,
            starter: starter.map(StarterSocket::new),
            gap: None,
            gaps: ReceptionGaps::default(),
            polled: Instant::now(),
            unsent: 0,
            connections: 0,
        }
    }

    /// Returns the events since the last call, as [`Feed::poll`]. Never waits.
    ///
    /// After a restart of the ingress, the topics are attached again: each one is an event of its
    /// own, and its samples are to be read from then on, after those in the earlier memory.
    ///
    /// # Errors
    ///
    /// Those of [`Feed::poll`]. [`FeedError::Gone`] if there is no starter, if it has ended, if
    /// there was no ingress for 60 s, or if the ingress has only closed this connection.
    pub fn poll(&mut self) -> Result<Vec<FeedEvent>, FeedError> {
        if let Some(starter) = &mut self.starter {
            starter.receive()?;
        }
        if self.gap.is_none() {
            match self.feed.poll() {
                Ok(events) => {
                    self.polled = Instant::now();
                    self.note(&events);
                    return Ok(events);
                }
                Err(FeedError::Gone) if self.starter.is_some() => self.begin_gap(),
                Err(error) => return Err(error),
            }
        }
        self.join().map(|()| Vec::new())
    }

    /// Returns the layout that the writers of a topic announce, as [`Feed::layout`]; `None` also if
    /// the ingress does not answer within a second.
    pub fn layout(&mut self, id: u32) -> Option<String> {
        // The next call of `poll` handles the end of the connection.
        self.feed.layout(id, LAYOUT_TIMEOUT).ok().flatten().filter(|_| self.gap.is_none())
    }

    /// As [`Feed::request_layout`].
    pub fn request_layout(&mut self, id: u32) -> Result<(), FeedError> {
        self.feed.request_layout(id)
    }

    /// Looks whether samples were lost in the last gap. Call it often while samples arrive: the
    /// numbers of those that have left cannot be read any more.
    pub fn look_for_losses(&mut self) {
        for topic in self.topics.values_mut() {
            topic.losses.look(&topic.attached.reader);
        }
    }

    /// Returns the times without reception so far.
    pub fn gaps(&self) -> ReceptionGaps {
        let ms = self.gap.as_ref().map_or(0, OpenGap::ms);
        ReceptionGaps { ms: self.gaps.ms.saturating_add(ms), ..self.gaps }
    }

    /// Returns false while the ingress has ended, and no other one was joined.
    pub fn has_ingress(&self) -> bool {
        self.gap.is_none()
    }

    /// Takes the connection to another recorder, if the starter has passed one.
    pub fn take_recorder(&mut self) -> Option<OwnedFd> {
        self.starter.as_mut()?.recorder.take()
    }

    /// Returns the newest state of the source. Counts are those of the current ingress.
    pub fn status(&self) -> &SourceStatus {
        self.feed.status()
    }

    /// Returns the state of a topic's subscription, with the counts of all ingresses so far; `None`
    /// if the ingress has not sent it.
    pub fn reception(&self, id: u32) -> Option<ReceptionStatus> {
        let found = self.status().topics.iter().find(|(known, _)| *known == id);
        let mut status = match (found, self.topics.get(&id)) {
            (Some((_, status)), _) => status.clone(),
            (None, Some(_)) if self.connections > 0 => ReceptionStatus::default(),
            (None, _) => return None,
        };
        if let Some(topic) = self.topics.get(&id) {
            if self.gap.is_some() {
                // Counted with those of earlier ingresses.
                status.malformed = 0;
            }
            topic.losses.add_to(&mut status);
        }
        Some(status)
    }

    /// Returns the number of messages of this process that were not published, by all ingresses so
    /// far.
    pub fn unsent(&self) -> u64 {
        self.unsent.saturating_add(self.status().unsent)
    }

    /// Returns the number of restarts after which the ingress was joined again. Each has another
    /// bell and other publishers.
    pub fn connections(&self) -> u32 {
        self.connections
    }

    /// As [`Feed::bell`], of the current ingress.
    pub fn bell(&self) -> Waker {
        self.feed.bell()
    }

    /// As [`Feed::publisher`], of the current ingress.
    pub fn publisher(&self, index: u32) -> Box<dyn Publisher> {
        self.feed.publisher(index)
    }

    /// As [`Feed::request_definitions`].
    pub fn request_definitions(&mut self, id: u32) -> Result<(), FeedError> {
        self.feed.request_definitions(id)
    }

    /// Notes topics that are attached, or attached again.
    fn note(&mut self, events: &[FeedEvent]) {
        for event in events {
            let FeedEvent::Attached(SharedTopicReader { info, reader }) = event else { continue };
            let attached = TopicMemory { reader: reader.clone(), first: info.first };
            match self.topics.get_mut(&info.id) {
                Some(topic) => {
                    topic.losses.end_gap(&attached);
                    topic.attached = attached;
                }
                None => {
                    let losses = TopicLosses::default();
                    self.topics.insert(info.id, LastingTopic { attached, losses });
                }
            }
        }
    }

    fn begin_gap(&mut self) {
        let last = &self.feed.status().topics;
        for (id, topic) in &mut self.topics {
            let last = last.iter().find(|(known, _)| known == id);
            let last = last.map(|(_, status)| status.clone()).unwrap_or_default();
            topic.losses.begin_gap(&topic.attached, &last);
        }
        let heads = self.topics.values().map(|topic| {
            let reader = topic.attached.reader.clone();
            let head = reader.head();
            (reader, head)
        });
        let (until, heads) = (Instant::now() + TIMEOUT, heads.collect());
        // It may have ended long before this process noticed it, and be joined again at once.
        self.gap = Some(OpenGap { since: self.polled, until, heads, joining: None });
        self.gaps.count = self.gaps.count.saturating_add(1);
    }

    /// Joins the next ingress, if the starter has passed a connection to it. If that one has ended
    /// meanwhile, what it received is read before a further one is joined.
    fn join(&mut self) -> Result<(), FeedError> {
        let Some(OpenGap { until, heads, joining, .. }) = &mut self.gap else { return Ok(()) };
        // An ingress that lives, and has closed this connection, overwrites what this process
        // holds.
        if heads.iter().any(|(reader, head)| reader.head() != *head) {
            return Err(FeedError::Gone);
        }
        if Instant::now() >= *until {
            return Err(FeedError::Gone);
        }
        let starter = self.starter.as_mut().ok_or(FeedError::Gone)?;
        loop {
            let connection = match joining.take() {
                Some(connection) => connection,
                None => match starter.ingresses.pop_front() {
                    Some(socket) => JoiningFeed::new(socket),
                    None if starter.has_ended => return Err(FeedError::Gone),
                    None => return Ok(()),
                },
            };
            match connection.poll() {
                Ok(ControlFlow::Continue(connection)) => {
                    *joining = Some(connection);
                    return Ok(());
                }
                Ok(ControlFlow::Break(feed)) => {
                    self.joined(feed);
                    return Ok(());
                }
                // It has ended without a message; the starter passes another connection.
                Err(FeedError::Gone) => {}
                Err(error) => return Err(error),
            }
        }
    }

    fn joined(&mut self, feed: Feed) {
        self.unsent = self.unsent();
        self.feed = feed;
        self.connections += 1;
        self.gaps = self.gaps();
        self.gap = None;
        self.polled = Instant::now();
    }
}

impl OpenGap {
    fn ms(&self) -> u64 {
        u64::try_from(self.since.elapsed().as_millis()).unwrap_or(u64::MAX)
    }
}
