//! Sends the records of all streams that the cloud does not have: a thread for each connection.
//!
//! Of each stream one batch is on its way at a time, and the next one follows when the cloud has
//! made it durable. A connection that is lost loses nothing: the next one goes on after the last
//! record that the cloud has. A batch is made durable here before it is sent, so that a power cut
//! takes nothing back that the cloud has. `collect` decides which records wait for others.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use gleaner_base::{RateLimit, chain};
use gleaner_fleet::{Ack, Body, Cursor, FRAME_MAX, RECORDS_MAX, Records, compress};
use gleaner_spool::{SpoolError, SpoolFolder, SpoolItem, SpoolReader, SpoolStorage};
use serde_json::json;
use tokio::sync::mpsc::Sender;

use super::Cloud;
use super::collect::{CollectedLines, LIVE_INTERVAL, TailLease};
use super::resume::resume;
use crate::streams::{STREAMS, line};

/// Interval of looks for new records.
const INTERVAL: Duration = Duration::from_secs(1);
/// Bytes of a batch, before they are compressed.
const BATCH: usize = 256 << 10;
/// Compressed bytes per second, and in a burst.
const RATE: RateLimit = RateLimit::of(262_144.0, 2_097_152.0);

/// The thread.
pub(super) struct Uplink {
    pub(super) spool: PathBuf,
    pub(super) cloud: Cloud,
    /// The last record of each stream that the cloud has.
    pub(super) cursors: BTreeMap<String, Cursor>,
    /// To the connection; it closes this with its end.
    pub(super) out: Sender<Body>,
    pub(super) orders: Receiver<UplinkOrder>,
}

/// A frame of the cloud about records.
pub(super) enum UplinkOrder {
    Ack(Ack),
    Tail(TailLease),
}

/// Pause before a stream that could not be opened is tried again.
const UNREADABLE: Duration = Duration::from_secs(60);

struct SentStream<S: SpoolStorage = SpoolFolder> {
    life: u64,
    reader: SpoolReader<S>,
    /// The position before the collected lines.
    batched: Option<u64>,
    collected: CollectedLines,
    /// True until all records of the time before the connection are read: they have waited.
    is_behind: bool,
    /// A batch that the rate does not allow yet.
    waits: Option<Batch>,
    /// The number after those that are on their way, and their count.
    on_its_way: Option<(u64, u64)>,
    /// The reason why it could not be read or made durable at the last look.
    failure: Option<String>,
}

struct Batch {
    lines: Vec<u8>,
    count: u64,
    next: u64,
}

impl Uplink {
    /// Runs until the connection ends.
    pub(super) fn run(self) {
        let mut streams: BTreeMap<String, SentStream> = BTreeMap::new();
        let (mut rate, mut lease) = (RATE, TailLease::default());
        let mut unreadable = BTreeMap::new();
        // Times of the next looks: at all streams, and at those that people read.
        let mut all_at = Instant::now();
        let mut live_at = all_at;
        while !self.out.is_closed() {
            let look_at = if lease.is_over(live_at) { all_at } else { all_at.min(live_at) };
            let wait = look_at.saturating_duration_since(Instant::now());
            match self.orders.recv_timeout(wait) {
                Ok(UplinkOrder::Ack(ack)) => {
                    let stream = streams.get_mut(&ack.stream).filter(|it| it.life == ack.life);
                    if let Some(stream) = stream
                        && let Some((next, _)) = stream.on_its_way.filter(|it| ack.next >= it.0)
                    {
                        stream.on_its_way = None;
                        // Without this note, the spool counts more as lost than was.
                        let _ = stream.reader.release(next);
                        // There may be more.
                        if !self.send(&ack.stream, stream, &mut rate, &lease) {
                            return;
                        }
                    }
                }
                // However many come, looks keep their interval.
                Ok(UplinkOrder::Tail(tail)) => lease = tail,
                Err(RecvTimeoutError::Timeout) => {
                    let now = Instant::now();
                    live_at = now + LIVE_INTERVAL;
                    let is_of_all = now >= all_at;
                    if is_of_all {
                        all_at = now + INTERVAL;
                        self.find_new(&mut streams, &mut unreadable);
                    }
                    let mut due =
                        streams.iter_mut().filter(|(name, _)| is_of_all || lease.has(name, now));
                    if !due.all(|(name, stream)| self.send(name, stream, &mut rate, &lease)) {
                        return;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
            let failing =
                streams.iter().filter_map(|(name, it)| Some((name, it.failure.as_ref()?)));
            let unopened = unreadable.iter().map(|(name, (_, error))| (name, error));
            let unsent: u64 = streams.values().map(SentStream::unsent).sum();
            self.cloud.set_unsent(unsent, failing.chain(unopened));
        }
    }

    /// Opens streams that did not exist before. `unreadable` has those that could not be opened,
    /// with the times of the next tries and the errors.
    fn find_new(
        &self,
        streams: &mut BTreeMap<String, SentStream>,
        unreadable: &mut BTreeMap<String, (Instant, String)>,
    ) {
        let own = STREAMS.iter().map(|name| (*name).to_owned());
        let mut found: Vec<_> = own.filter(|name| self.spool.join(name).is_dir()).collect();
        match lambda_streams(&self.spool) {
            Ok(names) => {
                found.extend(names);
                // The files of one that was removed are open, and its failure would stay.
                streams.retain(|name, stream| stream.failure.is_none() || found.contains(name));
                // The others are due, or were removed.
                let is_late = |until: &Instant| *until > Instant::now();
                unreadable.retain(|name, (until, _)| is_late(until) && found.contains(name));
            }
            Err(error) => {
                unreadable.insert("lambdas".to_owned(), (Instant::now(), error.to_string()));
            }
        }
        for name in found {
            if streams.contains_key(&name) || unreadable.contains_key(&name) {
                continue;
            }
            let folder = self.spool.join(&name);
            let opened = resume(&folder, last_part(&name), self.cursors.get(&name));
            let (life, reader) = match opened {
                Ok(opened) => opened,
                Err(error) => {
                    // Each look would read all of it.
                    let error = chain(&error);
                    tracing::warn!(stream = name, error, "cannot go on with a stream; will retry");
                    unreadable.insert(name, (Instant::now() + UNREADABLE, error));
                    continue;
                }
            };
            // Also back, if the spool has lost records that the cloud has.
            let _ = reader.release(reader.position().unwrap_or(0));
            streams.insert(name, SentStream::new(life, reader));
        }
    }

    /// Sends a batch of a stream, if one is due and none is on its way. Returns false if the
    /// connection has ended.
    fn send(
        &self,
        name: &str,
        stream: &mut SentStream,
        rate: &mut RateLimit,
        lease: &TailLease,
    ) -> bool {
        if stream.on_its_way.is_some() {
            return true;
        }
        let now = Instant::now();
        let batch = stream.waits.take().or_else(|| stream.batch(name, lease.has(name, now), now));
        let Some(batch) = batch else { return true };
        if !rate.take(batch.lines.len() as f64, now) {
            stream.waits = Some(batch);
            return true;
        }
        let Batch { lines, count, next } = batch;
        stream.on_its_way = Some((next, count));
        let records = Records { stream: name.to_owned(), life: stream.life, next, lines };
        self.out.blocking_send(Body::Records(records)).is_ok()
    }
}

impl<S: SpoolStorage> SentStream<S> {
    fn new(life: u64, mut reader: SpoolReader<S>) -> Self {
        reader.keep_durable();
        Self {
            life,
            batched: reader.position(),
            reader,
            collected: CollectedLines::default(),
            is_behind: true,
            waits: None,
            on_its_way: None,
            failure: None,
        }
    }

    /// Returns the number of records that are read and that the cloud does not have.
    fn unsent(&self) -> u64 {
        let waiting = self.waits.as_ref().map_or(0, |batch| batch.count);
        self.on_its_way.map_or(0, |(_, count)| count) + waiting + self.collected.count()
    }

    /// Reads the next records; returns those that are due, once they are durable.
    fn batch(&mut self, name: &str, is_read: bool, now: Instant) -> Option<Batch> {
        let read = self.collect(last_part(name), now);
        // Lines that were read before a failure do not wait until it ends.
        let has_failed = read.is_err() || self.failure.is_some();
        let is_due = self.is_behind || is_read || has_failed || self.collected.is_due(now);
        self.is_behind &= matches!(read, Ok(false));
        let is_sent = is_due && self.collected.count() > 0;
        let synced = if is_sent { self.reader.sync() } else { Ok(()) };
        if synced.is_err() {
            self.reader.rewind(self.batched);
            self.collected = CollectedLines::default();
        }
        let is_durable = is_sent && synced.is_ok();
        self.note(name, synced.err().or(read.err()));
        if !is_durable {
            return None;
        }
        self.batched = self.reader.position();
        let next = self.batched?;
        let (lines, count) = self.collected.take()?;
        Some(Batch { lines: compress(&lines), count, next })
    }

    /// Reads records up to a whole batch; returns whether there are no more for now.
    fn collect(&mut self, name: &str, now: Instant) -> Result<bool, SpoolError> {
        while self.collected.bytes() < BATCH && self.collected.count() < RECORDS_MAX as u64 {
            let item = match self.reader.next() {
                // A commit in progress, or one that a power cut interrupted: a gap follows.
                None | Some(Ok(SpoolItem::Torn(_))) => return Ok(true),
                Some(item) => item?,
            };
            let mut line = line(name, Ok(item));
            let mut encoded = serde_json::to_vec(&line).expect("a line is plain data");
            if encoded.len() > FRAME_MAX / 2 {
                let text = format!("a record of {} bytes is too long to be sent", encoded.len());
                (line.kind, line.record) = ("damaged".to_owned(), json!({ "text": text }));
                encoded = serde_json::to_vec(&line).expect("a line is plain data");
            }
            self.collected.add(&line, &encoded, now);
        }
        Ok(false)
    }

    /// Keeps the outcome of a look. A failure is logged, unless the look before has failed, too.
    fn note(&mut self, name: &str, failure: Option<SpoolError>) {
        let failure = failure.map(|error| chain(&error));
        if let (None, Some(error)) = (&self.failure, &failure) {
            tracing::warn!(stream = name, error, "cannot send a stream; will retry");
        }
        self.failure = failure;
    }
}

/// Returns the name of a stream in its segments: of a lambda's records, the id of its deployment.
fn last_part(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// Returns the names of the streams of lambdas in the folder of the spools.
fn lambda_streams(spool: &Path) -> io::Result<Vec<String>> {
    let entries = match fs::read_dir(spool.join("lambdas")) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let ids = entries.flatten().filter_map(|entry| entry.file_name().into_string().ok());
    Ok(ids.map(|id| format!("lambdas/{id}")).collect())
}

#[cfg(test)]
mod tests;
