//! One file during a replay: the subscriptions of its channels, and its next segment.

use std::path::Path;

use crate::catalog::DriveChannel;
use crate::chunk::{OpenSegment, Opener, message_head};
use crate::damage::Damage;
use crate::error::ReplayError;
use crate::file::{Contents, FileSegment};
use crate::inflate::{Inflate, ZSTD};
use crate::options::Span;
use crate::records::MESSAGE_HEAD;
#[cfg(feature = "bags")]
use crate::rows::MessageRows;
use crate::source::SourceFile;
use crate::writers::{ChannelWriter, Writers};
use gleaner_messages::Endian;
use gleaner_messages::transport::{Guid, SampleMeta, Subscription};

/// Bytes before the CDR of a message.
const ENCAPSULATION: usize = 4;

pub enum Store {
    /// Segments, found when the file was opened.
    Mcap(SourceFile),
    /// A database, which makes segments on demand.
    #[cfg(feature = "bags")]
    Rows(Box<MessageRows>),
}

impl Store {
    pub fn path(&self) -> &Path {
        match self {
            Self::Mcap(source) => source.path(),
            #[cfg(feature = "bags")]
            Self::Rows(rows) => rows.path(),
        }
    }

    fn damaged(&self, offset: u64, what: Damage) -> ReplayError {
        match self {
            Self::Mcap(source) => source.damaged(offset, what),
            #[cfg(feature = "bags")]
            Self::Rows(rows) => rows.damaged(what),
        }
    }
}

pub struct Track {
    store: Store,
    contents: Contents,
    times: Option<(u64, u64)>,
    recording: usize,
    span: Span,
    /// By channel id. Most files have a few channels with small ids, so a table beats a map.
    routes: Vec<Route>,
    /// The segments still to be opened, the next one last.
    queue: Vec<FileSegment>,
}

/// State of one channel id in a replay.
#[derive(Default)]
struct Route {
    /// `None` if the file does not define the channel.
    writer: Option<ChannelWriter>,
    subscriptions: Vec<ChannelSubscription>,
    /// Number of the layout of its messages among those of its topic.
    layout: u16,
    is_latched: bool,
    /// The largest message that a subscription takes, in bytes of CDR.
    max_bytes: usize,
    seen: u64,
}

#[derive(Copy, Clone)]
struct ChannelSubscription {
    by: Subscription,
    /// The largest message that it takes, in bytes of CDR.
    max_bytes: usize,
}

pub struct Routed<'a> {
    pub subscription: Subscription,
    /// Set if this is the last subscription of the message.
    pub is_last: bool,
    pub meta: SampleMeta,
    /// Set if the message is packed and larger than the subscription takes. Then `cdr` may be only
    /// its beginning.
    pub is_too_big: bool,
    /// Set if the message is not plain CDR. Then `cdr` is all of it.
    pub is_malformed: bool,
    pub cdr: &'a [u8],
}

impl Track {
    pub fn new(store: Store, contents: Contents, writers: &mut Writers, recording: usize) -> Self {
        let mut routes = Vec::new();
        for (id, writer) in writers.of_next_file(store.path(), &contents.channels) {
            // Ids are sorted, and 16 bits wide.
            routes.resize_with(usize::from(id) + 1, Route::default);
            let route = &mut routes[usize::from(id)];
            route.writer = Some(writer);
            route.is_latched = contents.channels.get(id).is_some_and(|info| info.is_latched);
        }
        Self {
            times: contents.span(),
            recording,
            span: Span::ALL,
            store,
            contents,
            routes,
            queue: Vec::new(),
        }
    }

    /// Returns whether opening it found damage.
    pub fn is_damaged(&self) -> bool {
        self.contents.damage.is_some()
    }

    pub fn recording(&self) -> usize {
        self.recording
    }

    pub fn topics(&self) -> impl Iterator<Item = &str> {
        let Contents { channels, messages, uncounted, .. } = &self.contents;
        let has_some = |id| *uncounted || messages.get(&id).is_some_and(|count| *count > 0);
        let all = channels.iter().filter(move |(id, _)| has_some(*id));
        all.map(|(_, info)| info.topic.as_str())
    }

    pub fn path_and_contents(&self) -> (&Path, &Contents) {
        (self.store.path(), &self.contents)
    }

    /// Returns the first and last log time of any message.
    pub fn times(&self) -> Option<(u64, u64)> {
        self.times
    }

    /// Returns whether the last of [`Track::times`] is lost, or no time of this age.
    pub fn is_end_unknown(&self) -> bool {
        let is_late = self.times.is_some_and(|(_, last)| i64::try_from(last).is_err());
        self.contents.is_end_unknown || is_late
    }

    /// Continues the numbers of a writer after `seq`, for the channels of a subscription.
    pub fn skip_to(&mut self, subscription: Subscription, guid: Guid, seq: u64) {
        let is_it = |route: &&Route| route.subscriptions.iter().any(|one| one.by == subscription);
        let writers = self.routes.iter().filter(is_it).filter_map(|route| route.writer.as_ref());
        writers.filter(|writer| writer.guid() == guid).for_each(|writer| writer.skip_to(seq));
    }

    /// Counts a message of `channel` that was left out, and returns its topic.
    pub fn leave_out(&mut self, channel: u16) -> String {
        if let Some(route) = self.routes.get_mut(usize::from(channel)) {
            route.seen += 1;
        }
        topic_of(&self.contents, channel)
    }

    pub fn damaged(&self, offset: u64, what: Damage) -> ReplayError {
        self.store.damaged(offset, what)
    }

    /// Subscribes a channel. `max_bytes` is the largest message to deliver, in bytes of CDR.
    pub fn subscribe(
        &mut self,
        channel: DriveChannel,
        subscription: Subscription,
        max_bytes: usize,
    ) {
        let layout = channel.layout;
        if let Some(channel) = self.routes.get_mut(usize::from(channel.id)) {
            channel.layout = layout;
            channel.subscriptions.push(ChannelSubscription { by: subscription, max_bytes });
            channel.max_bytes = channel.max_bytes.max(max_bytes);
        }
    }

    /// Queues the segments with subscribed messages of `span`. Returns the damage that the scan
    /// found, if any, and the log time before which everything is still delivered.
    pub fn start(&mut self, span: Span) -> Option<(u64, ReplayError)> {
        self.span = span;
        #[cfg(feature = "bags")]
        if let Store::Rows(rows) = &mut self.store {
            let routes = &self.routes;
            // A database reports by itself the damage that ends it.
            rows.start(span, self.contents.damage.take().map(|(_, what)| what), |id| {
                wanted(routes, id) == Some(true)
            });
            return None;
        }
        let last = self.contents.segments.iter().map(|segment| segment.end_time).max();
        self.queue = std::mem::take(&mut self.contents.segments);
        let routes = &self.routes;
        self.queue.retain(|segment| {
            let is_wanted = segment.channels.as_ref().is_none_or(|channels| {
                // An undefined channel is damage; the segment has to be opened to report it.
                channels.iter().any(|id| wanted(routes, *id) != Some(false))
            });
            is_wanted && span.meets(segment.start_time, segment.end_time)
        });
        self.queue.sort_by_key(|segment| std::cmp::Reverse((segment.start_time, segment.offset)));
        let (offset, what) = self.contents.damage.take()?;
        let before = last.map_or(0, |last| last.saturating_add(1));
        Some((before, self.store.damaged(offset, what)))
    }

    /// Returns the log time at which the next segment must be open.
    pub fn next_start(&self) -> Option<u64> {
        match &self.store {
            Store::Mcap(_) => self.queue.last().map(|segment| segment.start_time),
            #[cfg(feature = "bags")]
            Store::Rows(rows) => rows.next_start(),
        }
    }

    /// Opens the next segment and returns its position, or in a database, its number. After an
    /// error there are no more.
    pub fn open_next(
        &mut self,
        opener: &mut Opener,
        into: &mut OpenSegment,
    ) -> Result<u64, ReplayError> {
        let source = match &mut self.store {
            Store::Mcap(source) => source,
            #[cfg(feature = "bags")]
            Store::Rows(rows) => return rows.open_next(into),
        };
        let Some(segment) = self.queue.pop() else {
            return Ok(0);
        };
        let routes = &self.routes;
        let opened = opener.open(
            source,
            &segment,
            &self.contents.channels,
            self.span,
            |id| wanted(routes, id),
            into,
        );
        match opened {
            Ok(()) => Ok(segment.offset),
            Err(error) => {
                self.queue.clear();
                Err(error)
            }
        }
    }

    /// Parses the message record in `body`; `delivered` is the number of subscriptions that already
    /// received it. Packed messages are unpacked into `inflate`, and stay there until the next.
    #[inline]
    pub fn route<'a>(
        &mut self,
        body: &'a [u8],
        delivered: usize,
        inflate: &'a mut Inflate,
    ) -> Result<Routed<'a>, Damage> {
        let head = message_head(body)?;
        let channel = self
            .routes
            .get_mut(usize::from(head.channel))
            .ok_or(Damage::UnknownChannel(head.channel))?;
        let &wanted =
            channel.subscriptions.get(delivered).ok_or(Damage::UnknownChannel(head.channel))?;
        let writer = channel.writer.as_ref().ok_or(Damage::UnknownChannel(head.channel))?;
        let mut message = &body[MESSAGE_HEAD..];
        let is_packed = message.starts_with(&ZSTD);
        if is_packed {
            if delivered == 0 {
                unpack(message, channel.max_bytes, inflate, || {
                    topic_of(&self.contents, head.channel)
                })?;
            }
            message = inflate.bytes();
        }
        let (is_malformed, endian, options, cdr) = match message {
            &[0, 0, a, b, ref cdr @ ..] => (false, Endian::Big, [a, b], cdr),
            &[0, 1, a, b, ref cdr @ ..] => (false, Endian::Little, [a, b], cdr),
            other => (true, Endian::Little, [0; 2], other),
        };
        if delivered == 0 {
            writer.count(head.sequence);
            // `leave_out` counts the others.
            channel.seen += u64::from(!is_malformed);
        }
        Ok(Routed {
            subscription: wanted.by,
            is_last: delivered + 1 == channel.subscriptions.len(),
            meta: SampleMeta {
                at_ns: nanoseconds(head.log_time),
                publish_ns: nanoseconds(head.publish_time),
                writer: writer.guid(),
                seq: writer.last_seq(),
                endian,
                options,
                layout: channel.layout,
                is_latched: channel.is_latched,
            },
            is_malformed,
            is_too_big: is_packed && cdr.len() > wanted.max_bytes,
            cdr,
        })
    }

    /// Returns, at the end, the first subscribed channel whose number of messages differs from the
    /// summary.
    pub fn missing(&self) -> Option<ReplayError> {
        if !self.contents.claimed {
            return None;
        }
        self.contents.channels.iter().find_map(|(id, info)| {
            let channel = self.routes.get(usize::from(id))?;
            let expected = self.contents.messages.get(&id).copied().unwrap_or(0);
            if channel.subscriptions.is_empty() || channel.seen == expected {
                return None;
            }
            let (topic, found) = (info.topic.clone(), channel.seen);
            match &self.store {
                Store::Mcap(source) => {
                    Some(source.damaged(source.len(), Damage::Missing { topic, expected, found }))
                }
                // rosbag2 also counts messages that it could not write in time: its recorder lost
                // these, not this file.
                #[cfg(feature = "bags")]
                Store::Rows(rows) => {
                    let path = rows.path().display();
                    tracing::warn!(
                        %path,
                        topic,
                        expected,
                        found,
                        "metadata.yaml and the database differ in the number of messages"
                    );
                    None
                }
            }
        })
    }
}

/// Unpacks a message into `inflate`, up to the largest one that a subscription takes.
fn unpack(
    message: &[u8],
    max_bytes: usize,
    inflate: &mut Inflate,
    topic: impl Fn() -> String,
) -> Result<(), Damage> {
    let unpacked = inflate.unpack(message, max_bytes.saturating_add(ENCAPSULATION + 1));
    unpacked.map_err(|source| Damage::Unpack { topic: topic(), source })?;
    match inflate.is_full() {
        true => Err(Damage::MessageTooLarge { topic: topic(), allowed: inflate.allowed() }),
        false => Ok(()),
    }
}

fn topic_of(contents: &Contents, channel: u16) -> String {
    contents.channels.get(channel).map(|info| info.topic.clone()).unwrap_or_default()
}

/// Converts a time of a file, where times are unsigned. Log times of messages fit; index times and
/// publish times may be beyond the year 2262, and saturate.
pub fn nanoseconds(log_time: u64) -> i64 {
    i64::try_from(log_time).unwrap_or(i64::MAX)
}

/// Returns whether a channel is subscribed; `None` if the file does not define it.
fn wanted(routes: &[Route], id: u16) -> Option<bool> {
    let channel = routes.get(usize::from(id)).filter(|channel| channel.writer.is_some())?;
    Some(!channel.subscriptions.is_empty())
}
