//! Merges all files of a drive into one sequence of messages.

mod latched;

use std::cmp::Reverse;
use std::collections::binary_heap::PeekMut;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;

use latched::EarlierSample;

use crate::catalog::Catalog;
use crate::chunk::{OpenSegment, Opener};
use crate::damage::Damage;
use crate::error::ReplayError;
use crate::inflate::Inflate;
use crate::options::{DriveLimits, DriveOptions, Span};
use crate::separate::drives_of;
use crate::step::{Progress, ReplayStep};
use crate::storage;
use crate::track::{Routed, Track, nanoseconds};
use gleaner_messages::Definitions;
use gleaner_messages::transport::{
    Delivery, DiscoveredTopic, Sink, Subscription, TopicSpec, Transport, TransportError,
};
use tracing::warn;

/// A drive: one or more files and rosbag2 directories, replayed as one.
///
/// Messages come in log-time order; equal times come in the order of the files, then of the channel
/// ids, then of their positions in the file; in a database, of their numbers. A message with
/// several subscriptions is delivered to each in a step of its own.
///
/// # Damage
///
/// Chunks are delivered whole or not at all: a chunk whose checksum, compression or records are
/// wrong is damaged as a whole. A damaged file ends the drive, for all files, with one
/// [`ReplayError::Damaged`] from [`Replay::step`] or [`Replay::peek_at_ns`]; after it there is
/// nothing more. Before it:
///
/// - In a finished file with a usable summary, a damaged chunk is reported when its turn comes.
///   Every message of every file whose log time is before that chunk's start time was delivered.
/// - In a file without a usable summary (truncated, never finished, summary damaged), opening finds
///   the damage, and the readable part ends where the damage begins. Every message in that part was
///   delivered, in log-time order, and every message of the other files up to the last log time in
///   that part.
///
/// A message that is not plain CDR, or has a log time after the year 2262, is no damage: it is left
/// out, and counted by [`Replay::malformed`]. The first one of a topic is logged. One that is not
/// CDR still is a step, of [`Delivery::Malformed`].
///
/// A file that is readable to its end is replayed as a whole and then reported as damaged if it has
/// no footer, a damaged summary, or another number of messages of a subscribed topic than in its
/// summary. If the index states other times of a chunk than the chunk itself, the file is read as
/// one without an index, and is then reported as damaged as well. Messages outside chunks have no
/// checksum of their own; if the checksum of the whole data section is wrong, that is reported
/// after these messages. A writer may leave out any checksum; then only contradictions are noticed.
///
/// A database has no checksums: a contradiction of its pages is noticed when its turn comes, and
/// every message before was delivered. The same holds for a packed file that can be unpacked only
/// in part.
pub struct Replay {
    tracks: Vec<Track>,
    catalog: Arc<Catalog>,
    subscribed: Vec<(TopicSpec, Arc<dyn Sink>)>,
    /// Paths and options of the drive, if latched samples from before the part to replay are
    /// delivered.
    opened: Option<(Vec<PathBuf>, DriveOptions)>,
    /// These samples, which come first.
    latched: VecDeque<EarlierSample>,
    /// The error before the part to replay for which there are none.
    without_latched: Option<ReplayError>,
    opener: Opener,
    /// Unpacks messages that are packed one by one.
    inflate: Inflate,
    limits: DriveLimits,
    span: Span,
    /// The next message of every open segment, earliest on top.
    heads: BinaryHeap<Reverse<Head>>,
    open: Vec<OpenSegment>,
    /// Free indices of `open`.
    free: Vec<usize>,
    open_bytes: u64,
    /// Log time at which the next segment must be open, and the track that has it.
    next_open: Option<(u64, usize)>,
    /// The error that ends the drive, and the log time before which everything is still delivered.
    damage: Option<(u64, ReplayError)>,
    started: bool,
    ended: bool,
    /// Number of subscriptions that the top message was already delivered to.
    delivered: usize,
    last_at_ns: i64,
    out_of_order: u64,
    /// Messages that were left out, by topic.
    malformed: BTreeMap<String, u64>,
    types: BTreeMap<String, String>,
    progress: Progress,
}

/// The next message of an open segment. The order of the fields is the order of delivery.
#[derive(Copy, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Head {
    log_time: u64,
    track: usize,
    channel: u16,
    /// Position of the segment in its file.
    offset: u64,
    slot: usize,
}

impl Replay {
    /// Opens the files of a drive and finds out their content.
    ///
    /// A directory must be one that rosbag2 wrote: its files are those that its metadata name, or
    /// without metadata, those with known file names. Files with a summary, and databases, cost a
    /// few reads; a file without a summary is read through once, and a packed one is unpacked.
    ///
    /// # Errors
    ///
    /// [`ReplayError`] if there is no file, one cannot be opened, is of an unknown format or given
    /// twice. Damage further inside is reported by [`Replay::step`].
    pub fn open(paths: &[PathBuf]) -> Result<Self, ReplayError> {
        Self::open_as(paths, &DriveOptions { merge: true, ..DriveOptions::default() })
    }

    /// Opens a drive as [`Replay::open`] does, with other limits.
    ///
    /// # Errors
    ///
    /// As [`Replay::open`].
    pub fn open_with(paths: &[PathBuf], limits: DriveLimits) -> Result<Self, ReplayError> {
        Self::open_as(paths, &DriveOptions { limits, merge: true, ..DriveOptions::default() })
    }

    /// Opens a drive as [`Replay::open`] does, with all options.
    ///
    /// # Errors
    ///
    /// As [`Replay::open`]; [`ReplayError::Overlap`] and [`ReplayError::Separate`] without
    /// [`DriveOptions::merge`].
    pub fn open_as(paths: &[PathBuf], options: &DriveOptions) -> Result<Self, ReplayError> {
        if paths.is_empty() {
            return Err(ReplayError::NoFiles);
        }
        let mut opener = Opener::new(options.limits);
        let (tracks, recordings) = storage::open(paths, options, &mut opener)?;
        if !options.merge {
            let drives = drives_of(&tracks, &recordings)?;
            if drives.len() > 1 {
                return Err(ReplayError::Separate { drives });
            }
        }
        let files: Vec<_> = tracks.iter().map(Track::path_and_contents).collect();
        let catalog = Arc::new(Catalog::build(&files, options.sources.clone()));
        Ok(Self {
            tracks,
            catalog,
            subscribed: Vec::new(),
            opened: None,
            latched: VecDeque::new(),
            without_latched: None,
            opener,
            inflate: Inflate::new(options.limits.chunk_bytes),
            limits: options.limits,
            span: Span::ALL,
            heads: BinaryHeap::new(),
            open: Vec::new(),
            free: Vec::new(),
            open_bytes: 0,
            next_open: None,
            damage: None,
            started: false,
            ended: false,
            delivered: 0,
            last_at_ns: i64::MIN,
            out_of_order: 0,
            malformed: BTreeMap::new(),
            types: BTreeMap::new(),
            progress: Progress { done: 0, total: Some(0) },
        })
    }

    /// Replays only messages with a log time from `from_ns` on and before `to_ns`; must be called
    /// before the first step.
    ///
    /// Later damage is not reported, as it costs none of these messages.
    pub fn restrict(&mut self, from_ns: i64, to_ns: i64) {
        self.span = Span::between(from_ns, to_ns);
        self.progress.total = None;
    }

    /// Delivers the next message of a subscribed topic to its sink; `None` at the end of the drive.
    ///
    /// # Errors
    ///
    /// [`ReplayError::Damaged`], [`ReplayError::WithoutLatched`] or [`ReplayError::Read`], once;
    /// see [`Replay`] for what was delivered before. Every later call returns `None`.
    pub fn step(&mut self) -> Result<Option<ReplayStep>, ReplayError> {
        self.start()?;
        if let Some(earlier) = self.latched.pop_front() {
            return Ok(Some(self.deliver_latched(earlier)));
        }
        if !self.advance_to_head()? {
            return Ok(None);
        }
        let Some(Reverse(head)) = self.heads.peek().copied() else {
            return Ok(None);
        };
        let segment = &self.open[head.slot];
        let track = &mut self.tracks[head.track];
        let routed = segment
            .head()
            .ok_or(Damage::Malformed("a chunk has no current message"))
            .and_then(|entry| track.route(segment.body(entry), self.delivered, &mut self.inflate));
        let Routed { subscription, is_last, meta, is_too_big, is_malformed, cdr } = match routed {
            Ok(routed) => routed,
            Err(what) => {
                let error = track.damaged(head.offset, what);
                return Err(self.end(error));
            }
        };
        let (_, sink) = &self.subscribed[subscription.0];
        let delivery = if is_malformed {
            if self.delivered == 0 {
                let why = format!("it begins with {:02x?}", &cdr[..cdr.len().min(4)]);
                leave_out(&mut self.malformed, track, head.channel, &why);
            }
            Delivery::Malformed
        } else if is_too_big {
            sink.too_big(&meta, cdr.len());
            Delivery::TooBig
        } else {
            sink.deliver(&meta, cdr)
        };
        let step = ReplayStep { at_ns: meta.at_ns, subscription, delivery, meta, bytes: cdr.len() };
        if meta.at_ns < self.last_at_ns {
            self.out_of_order += u64::from(self.delivered == 0);
        }
        self.last_at_ns = self.last_at_ns.max(meta.at_ns);
        self.progress.done += 1;
        if is_last {
            self.delivered = 0;
            self.pop();
        } else {
            self.delivered += 1;
        }
        Ok(Some(step))
    }

    /// Returns the log time of the message that the next [`Replay::step`] delivers, in ns; `None`
    /// at the end.
    ///
    /// # Errors
    ///
    /// As [`Replay::step`]: an error reported here is not reported again.
    pub fn peek_at_ns(&mut self) -> Result<Option<i64>, ReplayError> {
        self.start()?;
        if !self.latched.is_empty() {
            return Ok(Some(nanoseconds(self.span.from)));
        }
        if !self.advance_to_head()? {
            return Ok(None);
        }
        Ok(self.heads.peek().map(|Reverse(head)| nanoseconds(head.log_time)))
    }

    /// Returns the log time of the first message of any topic, in ns; `None` if there is none.
    pub fn start_ns(&self) -> Option<i64> {
        let starts = self.tracks.iter().filter_map(|track| track.times().map(|times| times.0));
        starts.min().map(nanoseconds)
    }

    /// Returns the log time of the last message of any topic, in ns; `None` if there is none, or if
    /// it is unknown, as in a truncated database.
    pub fn end_ns(&self) -> Option<i64> {
        if self.tracks.iter().any(Track::is_end_unknown) {
            return None;
        }
        let ends = self.tracks.iter().filter_map(|track| track.times().map(|times| times.1));
        ends.max().map(nanoseconds)
    }

    pub(super) fn catalog(&self) -> Arc<Catalog> {
        Arc::clone(&self.catalog)
    }

    /// Checks whether a topic can be subscribed with `spec`.
    ///
    /// # Errors
    ///
    /// The error of [`Transport::subscribe`].
    pub fn can_subscribe(&self, spec: &TopicSpec) -> Result<(), TransportError> {
        self.catalog.select(spec).map(drop)
    }

    /// Returns the number of messages so far that were left out, for each subscribed topic that has
    /// some: they are no plain CDR, or their log time is after the year 2262.
    pub fn malformed(&self) -> &BTreeMap<String, u64> {
        &self.malformed
    }

    pub fn progress(&self) -> Progress {
        self.progress
    }

    /// Returns the number of messages delivered after one with a later log time. 0 unless
    /// [`DriveLimits::open_bytes`] was reached.
    pub fn out_of_order(&self) -> u64 {
        self.out_of_order
    }

    /// Opens all segments that must be open for the top of `heads` to be the next message; false at
    /// the end.
    fn advance_to_head(&mut self) -> Result<bool, ReplayError> {
        if self.ended {
            return Ok(false);
        }
        // No other message comes between two deliveries of one message.
        if self.delivered > 0 {
            return Ok(true);
        }
        while let Some((start, track)) = self.next_open {
            let top = self.heads.peek().map(|Reverse(head)| head.log_time);
            let is_full = top.is_some() && self.open_bytes >= self.limits.open_bytes;
            let is_past_damage = self.damage.as_ref().is_some_and(|(before, _)| *before <= start);
            if top.is_some_and(|top| top < start) || is_full || is_past_damage {
                break;
            }
            self.open_next(start, track)?;
        }
        let top = self.heads.peek().map(|Reverse(head)| head.log_time);
        if let Some((before, error)) = self.damage.take() {
            if top.is_none_or(|top| top >= before) {
                return Err(self.end(error));
            }
            self.damage = Some((before, error));
        }
        if top.is_none() {
            let missing = if self.span == Span::ALL {
                self.tracks.iter().find_map(Track::missing)
            } else {
                None
            };
            if let Some(error) = missing.or(self.without_latched.take()) {
                return Err(self.end(error));
            }
            self.ended = true;
        }
        Ok(top.is_some())
    }

    /// Reads what has to be known before the first step, which otherwise does it.
    ///
    /// # Errors
    ///
    /// As [`Replay::open_as`], if the drive is opened again for latched samples.
    pub fn start(&mut self) -> Result<(), ReplayError> {
        if std::mem::replace(&mut self.started, true) {
            return Ok(());
        }
        if let Some((paths, options)) = self.opened.take().filter(|_| self.span.from > 0) {
            self.read_latched(&paths, &options)?;
        }
        for track in &mut self.tracks {
            if let Some((before, error)) = track.start(self.span)
                && !self.span.ends_before(before)
            {
                keep_earlier(&mut self.damage, before, error);
            }
        }
        self.find_next_open();
        Ok(())
    }

    fn open_next(&mut self, start: u64, index: usize) -> Result<(), ReplayError> {
        let slot = self.free.pop().unwrap_or_else(|| {
            self.open.push(OpenSegment::default());
            self.open.len() - 1
        });
        let track = &mut self.tracks[index];
        let into = &mut self.open[slot];
        let opened = track.open_next(&mut self.opener, into);
        for channel in into.take_late() {
            leave_out(&mut self.malformed, track, channel, "its log time is after the year 2262");
        }
        match (opened, into.head()) {
            (Ok(offset), Some(entry)) => {
                self.open_bytes += into.len() as u64;
                let (log_time, channel) = (entry.log_time, entry.channel);
                self.heads.push(Reverse(Head { log_time, track: index, channel, offset, slot }));
            }
            (Ok(_), None) => self.free.push(slot),
            (Err(error @ ReplayError::Damaged { .. }), _) => {
                self.free.push(slot);
                keep_earlier(&mut self.damage, start, error);
            }
            (Err(error), _) => return Err(self.end(error)),
        }
        self.find_next_open();
        Ok(())
    }

    fn find_next_open(&mut self) {
        let starts = self.tracks.iter().enumerate();
        self.next_open =
            starts.filter_map(|(index, track)| Some((track.next_start()?, index))).min();
    }

    /// Advances past the top message.
    fn pop(&mut self) {
        let Some(mut top) = self.heads.peek_mut() else {
            return;
        };
        let Reverse(head) = &mut *top;
        let segment = &mut self.open[head.slot];
        segment.advance();
        match segment.head() {
            Some(entry) => {
                head.log_time = entry.log_time;
                head.channel = entry.channel;
            }
            None => {
                self.open_bytes -= segment.len() as u64;
                self.free.push(head.slot);
                PeekMut::pop(top);
            }
        }
    }

    fn end(&mut self, error: ReplayError) -> ReplayError {
        self.ended = true;
        self.heads.clear();
        self.open = Vec::new();
        self.next_open = None;
        error
    }
}

impl Transport for Replay {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        self.catalog.topics()
    }

    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        if self.started {
            return Err(TransportError::AlreadyStarted { topic: spec.topic.clone() });
        }
        let selected = self.catalog.select(spec)?;
        let subscription = Subscription(self.subscribed.len());
        for channel in selected.channels {
            self.tracks[channel.file].subscribe(*channel, subscription, spec.max_bytes);
        }
        if self.types.insert(spec.topic.clone(), spec.type_name.clone()).is_none() {
            self.catalog.warn_of_other_types(spec);
        }
        let expected = self.progress.total.zip(selected.messages);
        self.progress.total = expected.map(|(total, messages)| total.saturating_add(messages));
        self.subscribed.push((spec.clone(), sink));
        Ok(subscription)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        self.catalog.definitions(topic, self.types.get(topic).map(String::as_str))
    }
}

/// Counts a message that is left out, and names the first one of its topic.
fn leave_out(counts: &mut BTreeMap<String, u64>, track: &mut Track, channel: u16, why: &str) {
    let topic = track.leave_out(channel);
    let path = track.path_and_contents().0.display();
    match counts.get_mut(&topic) {
        Some(count) => *count += 1,
        None => {
            warn!(%path, topic, why, "skipped a message; more of its topic are only counted");
            counts.insert(topic, 1);
        }
    }
}

fn keep_earlier(damage: &mut Option<(u64, ReplayError)>, before: u64, error: ReplayError) {
    if damage.as_ref().is_none_or(|(known, _)| before < *known) {
        *damage = Some((before, error));
    }
}
