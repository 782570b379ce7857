//! Sends the records of all streams that the cloud does not have: a thread for each connection.
//!
//! Of each stream one batch is on its way at a time, and the next one follows when the cloud has
//! made it durable. A connection that is lost loses nothing: the next one goes on after the last
//! record that the cloud has. `collect` decides which records wait for others.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use gleaner_base::{RateLimit, chain};
use gleaner_fleet::{Ack, Body, Cursor, FRAME_MAX, RECORDS_MAX, Records, compress};
use gleaner_spool::{SpoolItem, SpoolReader};
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

struct SentStream {
    life: u64,
    reader: SpoolReader,
    collected: CollectedLines,
    /// True until all records of the time before the connection are read: they have waited.
    is_behind: bool,
    /// A batch that the rate does not allow yet.
    waits: Option<Batch>,
    /// The number after those that are on their way, and their count.
    on_its_way: Option<(u64, u64)>,
    /// True once it could not be read.
    is_unreadable: bool,
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
                        && stream.on_its_way.is_some_and(|(next, _)| ack.next >= next)
                    {
                        stream.on_its_way = None;
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
                        self.find_new(&mut streams);
                    }
                    let mut due =
                        streams.iter_mut().filter(|(name, _)| is_of_all || lease.has(name, now));
                    if !due.all(|(name, stream)| self.send(name, stream, &mut rate, &lease)) {
                        return;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
            self.cloud.lock().unsent = streams.values().map(SentStream::unsent).sum();
        }
    }

    /// Opens streams that did not exist before.
    fn find_new(&self, streams: &mut BTreeMap<String, SentStream>) {
        for name in names(&self.spool) {
            if streams.contains_key(&name) {
                continue;
            }
            let folder = self.spool.join(&name);
            let opened = resume(&folder, last_part(&name), self.cursors.get(&name));
            let Ok((life, reader)) = opened else { continue };
            let stream = SentStream {
                life,
                reader,
                collected: CollectedLines::default(),
                is_behind: true,
                waits: None,
                on_its_way: None,
                is_unreadable: false,
            };
            streams.insert(name, stream);
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

impl SentStream {
    /// Returns the number of records that are read and that the cloud does not have.
    fn unsent(&self) -> u64 {
        let waiting = self.waits.as_ref().map_or(0, |batch| batch.count);
        self.on_its_way.map_or(0, |(_, count)| count) + waiting + self.collected.count()
    }

    /// Reads the next records; returns those that are due.
    fn batch(&mut self, name: &str, is_read: bool, now: Instant) -> Option<Batch> {
        let is_at_end = self.collect(last_part(name), now);
        let is_due = self.is_behind || is_read || self.collected.is_due(now);
        self.is_behind &= !is_at_end;
        if !is_due {
            return None;
        }
        let next = self.reader.position()?;
        let (lines, count) = self.collected.take()?;
        Some(Batch { lines: compress(&lines), count, next })
    }

    /// Reads records up to a whole batch; returns whether there are no more for now.
    fn collect(&mut self, name: &str, now: Instant) -> bool {
        while self.collected.bytes() < BATCH && self.collected.count() < RECORDS_MAX as u64 {
            if self.is_unreadable {
                return true;
            }
            let item = match self.reader.next() {
                // A commit in progress, or one that a power cut interrupted: a gap follows.
                None | Some(Ok(SpoolItem::Torn(_))) => return true,
                Some(item) => item,
            };
            if let Err(error) = &item {
                tracing::warn!(stream = name, error = chain(error), "a stream cannot be sent");
                self.is_unreadable = true;
                return true;
            }
            let mut line = line(name, item);
            let mut encoded = serde_json::to_vec(&line).expect("a line is plain data");
            if encoded.len() > FRAME_MAX / 2 {
                let text = format!("a record of {} bytes is too long to be sent", encoded.len());
                (line.kind, line.record) = ("damaged".to_owned(), json!({ "text": text }));
                encoded = serde_json::to_vec(&line).expect("a line is plain data");
            }
            self.collected.add(&line, &encoded, now);
        }
        false
    }
}

/// Returns the name of a stream in its segments: of a lambda's records, the id of its deployment.
fn last_part(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// Returns the names of all streams in the folder of the spools.
fn names(spool: &Path) -> Vec<String> {
    let own = STREAMS.iter().map(|name| (*name).to_owned());
    let own = own.filter(|name| spool.join(name).is_dir());
    let lambdas = fs::read_dir(spool.join("lambdas")).into_iter().flatten().flatten();
    let lambdas = lambdas.filter_map(|entry| entry.file_name().into_string().ok());
    own.chain(lambdas.map(|id| format!("lambdas/{id}"))).collect()
}

#[cfg(test)]
mod tests;
