//! One file during a replay: which of its channels go where, and which segment comes next.

use std::path::Path;

use super::chunk::{OpenSegment, Opener, Segment, message_head};
use super::error::{Damage, ReplayError};
use super::file::Contents;
use super::records::MESSAGE_HEAD;
use super::source::Source;
use super::writers::{Writer, Writers};
use crate::message::Endian;
use crate::transport::{SampleMeta, Subscription};

/// A file of a drive.
pub(super) struct Track {
    source: Source,
    contents: Contents,
    span: Option<(u64, u64)>,
    /// By channel id. Most files have a few channels with small ids, so a table beats a map.
    routes: Vec<Channel>,
    /// The segments still to open, the next one last.
    queue: Vec<Segment>,
}

/// What a replay knows of one channel id.
#[derive(Default)]
struct Channel {
    /// `None` if the file does not define the channel.
    writer: Option<Writer>,
    subscriptions: Vec<Subscription>,
    seen: u64,
}

/// A message on its way to a sink.
pub(super) struct Routed<'a> {
    pub(super) subscription: Subscription,
    /// Whether no further subscription wants the message.
    pub(super) is_last: bool,
    pub(super) meta: SampleMeta,
    pub(super) cdr: &'a [u8],
}

impl Track {
    pub(super) fn new(source: Source, contents: Contents, writers: &mut Writers) -> Self {
        let mut routes = Vec::new();
        for (id, writer) in writers.of_next_file(source.path(), &contents.channels) {
            // Ids come in order, and are 16 bits wide.
            routes.resize_with(usize::from(id) + 1, Channel::default);
            routes[usize::from(id)].writer = Some(writer);
        }
        Self { span: contents.span(), source, contents, routes, queue: Vec::new() }
    }

    pub(super) fn path_and_contents(&self) -> (&Path, &Contents) {
        (self.source.path(), &self.contents)
    }

    /// First and last log time of any message.
    pub(super) fn span(&self) -> Option<(u64, u64)> {
        self.span
    }

    pub(super) fn damaged(&self, offset: u64, what: Damage) -> ReplayError {
        self.source.damaged(offset, what)
    }

    pub(super) fn subscribe(&mut self, channel: u16, subscription: Subscription) {
        if let Some(channel) = self.routes.get_mut(usize::from(channel)) {
            channel.subscriptions.push(subscription);
        }
    }

    /// Lines up the segments that hold subscribed messages. Returns the damage that the scan found,
    /// if any, and the log time before which everything still counts.
    pub(super) fn start(&mut self) -> Option<(u64, ReplayError)> {
        let last = self.contents.segments.iter().map(|segment| segment.end_time).max();
        self.queue = std::mem::take(&mut self.contents.segments);
        let routes = &self.routes;
        self.queue.retain(|segment| {
            segment.channels.as_ref().is_none_or(|channels| {
                // An undefined channel is damage; the segment has to be opened to report it.
                channels.iter().any(|id| wanted(routes, *id) != Some(false))
            })
        });
        self.queue.sort_by_key(|segment| std::cmp::Reverse((segment.start_time, segment.offset)));
        let (offset, what) = self.contents.damage.take()?;
        let before = last.map_or(0, |last| last.saturating_add(1));
        Some((before, self.source.damaged(offset, what)))
    }

    /// The log time at which the next segment has to be open.
    pub(super) fn next_start(&self) -> Option<u64> {
        self.queue.last().map(|segment| segment.start_time)
    }

    /// Opens the next segment and returns where it lies. After an error there are no more.
    pub(super) fn open_next(&mut self, opener: &mut Opener, into: &mut OpenSegment) -> Result<u64, ReplayError> {
        let Some(segment) = self.queue.pop() else {
            return Ok(0);
        };
        let routes = &self.routes;
        let opened = opener.open(&mut self.source, &segment, |id| wanted(routes, id), into);
        match opened {
            Ok(()) => Ok(segment.offset),
            Err(error) => {
                self.queue.clear();
                Err(error)
            }
        }
    }

    /// Takes apart the message record in `body`; `fan` says how many subscriptions already have it.
    #[inline]
    pub(super) fn route<'a>(&mut self, body: &'a [u8], fan: usize) -> Result<Routed<'a>, Damage> {
        let head = message_head(body)?;
        let channel = self.routes.get_mut(usize::from(head.channel)).ok_or(Damage::UnknownChannel(head.channel))?;
        let &subscription = channel.subscriptions.get(fan).ok_or(Damage::UnknownChannel(head.channel))?;
        let writer = channel.writer.as_ref().ok_or(Damage::UnknownChannel(head.channel))?;
        let (endian, options, cdr) = match &body[MESSAGE_HEAD..] {
            &[0, 0, a, b, ref cdr @ ..] => (Endian::Big, [a, b], cdr),
            &[0, 1, a, b, ref cdr @ ..] => (Endian::Little, [a, b], cdr),
            other => {
                let topic = self.contents.channels.get(head.channel);
                let topic = topic.map(|info| info.topic.clone()).unwrap_or_default();
                return Err(Damage::Encapsulation { topic, found: other[..other.len().min(4)].to_vec() });
            }
        };
        if fan == 0 {
            writer.count(head.sequence);
            channel.seen += 1;
        }
        Ok(Routed {
            subscription,
            is_last: fan + 1 == channel.subscriptions.len(),
            meta: SampleMeta {
                at_ns: nanoseconds(head.log_time),
                publish_ns: nanoseconds(head.publish_time),
                writer: writer.guid(),
                seq: writer.last_seq(),
                endian,
                options,
            },
            cdr,
        })
    }

    /// At the end: the first subscribed channel that did not hold what the summary claims.
    pub(super) fn missing(&self) -> Option<ReplayError> {
        if !self.contents.claimed {
            return None;
        }
        self.contents.channels.iter().find_map(|(id, info)| {
            let channel = self.routes.get(usize::from(id))?;
            let expected = self.contents.messages.get(&id).copied().unwrap_or(0);
            if channel.subscriptions.is_empty() || channel.seen == expected {
                return None;
            }
            let topic = info.topic.clone();
            let what = Damage::Missing { topic, expected, found: channel.seen };
            Some(self.source.damaged(self.source.len(), what))
        })
    }
}

/// Log times are unsigned; one beyond the year 2262 reads as the end of time.
pub(super) fn nanoseconds(log_time: u64) -> i64 {
    i64::try_from(log_time).unwrap_or(i64::MAX)
}

/// Whether a channel is subscribed; `None` if the file does not define it.
fn wanted(routes: &[Channel], id: u16) -> Option<bool> {
    let channel = routes.get(usize::from(id)).filter(|channel| channel.writer.is_some())?;
    Some(!channel.subscriptions.is_empty())
}
