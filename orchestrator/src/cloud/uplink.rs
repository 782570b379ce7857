//! Sends the records of all streams that the cloud does not have: a thread for each connection.
//!
//! Of each stream one batch is on its way at a time, and the next one follows when the cloud has
//! made it durable. A connection that is lost loses nothing: the next one goes on after the last
//! record that the cloud has. A batch is made durable here before it is sent, so that a power cut
//! takes nothing back that the cloud has. `collect` decides which records wait for others.
//!
//! A stream that fails keeps no other one from being sent. It is tried again, and the status of the
//! vehicle has its cause and the time of the last try until it succeeds.

use std::collections::BTreeMap;
use std::error::Error;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use gleaner_base::{RateLimit, chain};
use gleaner_fleet::{Ack, Body, Cursor, FRAME_MAX, RECORDS_MAX, Records, compress};
use gleaner_spool::{GapReason, SpoolError, SpoolGap, SpoolItem, SpoolReader, SpoolStorage};
use serde_json::json;
use tokio::sync::mpsc::Sender;

use super::Cloud;
use super::collect::{CollectedLines, LIVE_INTERVAL, TailLease};
use super::resume::resume;
use crate::spools::{SpoolFolders, SpoolSource, last_part};
use crate::streams::line;

/// Interval of looks for new records.
const INTERVAL: Duration = Duration::from_secs(1);
/// Bytes of a batch, before they are compressed.
const BATCH: usize = 256 << 10;
/// Compressed bytes per second, and in a burst.
const RATE: RateLimit = RateLimit::of(262_144.0, 2_097_152.0);
/// Pause before a stream that failed is opened again: each try may read all of it.
const UNOPENED: Duration = Duration::from_secs(16);

pub(super) struct Uplink<P: SpoolSource = SpoolFolders> {
    spools: P,
    cloud: Cloud,
    /// The last record of each stream that the cloud has.
    cursors: BTreeMap<String, Cursor>,
    /// To the connection; it closes this with its end.
    out: Sender<Body>,
    streams: BTreeMap<String, SentStream<P::Storage>>,
    /// Those that failed at their last try.
    failing: BTreeMap<String, FailedTry>,
    rate: RateLimit,
    lease: TailLease,
}

/// A frame of the cloud about records.
pub(super) enum UplinkOrder {
    Ack(Ack),
    Tail(TailLease),
}

#[derive(Debug, Clone)]
pub(super) struct FailedTry {
    /// The error at the root.
    pub(super) cause: String,
    /// The failed action, with its causes.
    pub(super) text: String,
    pub(super) since: Instant,
    pub(super) tried: Instant,
}

struct SentStream<S: SpoolStorage> {
    life: u64,
    reader: SpoolReader<S>,
    /// The position before the collected lines.
    batched: Option<u64>,
    collected: CollectedLines,
    /// True until all records of the time before the connection are read: they have waited.
    is_behind: bool,
    /// A batch that the rate does not allow yet.
    waits: Option<Batch>,
    /// The number after those that are on their way.
    on_its_way: Option<u64>,
    /// The number before which the cloud has all, if the spool could not note it yet.
    unreleased: Option<u64>,
}

struct Batch {
    lines: Vec<u8>,
    next: u64,
}

impl<P: SpoolSource> Uplink<P> {
    pub(super) fn new(
        spools: P,
        cloud: Cloud,
        cursors: BTreeMap<String, Cursor>,
        out: Sender<Body>,
    ) -> Self {
        // Those of the connection before fail until they are tried.
        let (streams, failing) = (BTreeMap::new(), cloud.lock().failing.clone());
        let (rate, lease) = (RATE, TailLease::default());
        Self { spools, cloud, cursors, out, streams, failing, rate, lease }
    }

    /// Runs until the connection ends.
    pub(super) fn run(mut self, orders: &Receiver<UplinkOrder>) {
        // Times of the next looks: at all streams, and at those that people read.
        let mut all_at = Instant::now();
        let mut live_at = all_at;
        while !self.out.is_closed() {
            let is_live = !self.lease.is_over(live_at);
            let look_at = if is_live { all_at.min(live_at) } else { all_at };
            let wait = look_at.saturating_duration_since(Instant::now());
            let is_open = match orders.recv_timeout(wait) {
                Ok(UplinkOrder::Ack(ack)) => self.acknowledged(&ack, Instant::now()),
                // However many come, looks keep their interval.
                Ok(UplinkOrder::Tail(tail)) => {
                    self.lease = tail;
                    true
                }
                Err(RecvTimeoutError::Timeout) => {
                    let now = Instant::now();
                    live_at = now + LIVE_INTERVAL;
                    let is_of_all = now >= all_at;
                    if is_of_all {
                        all_at = now + INTERVAL;
                    }
                    self.look(is_of_all, now)
                }
                Err(RecvTimeoutError::Disconnected) => false,
            };
            if !is_open {
                return;
            }
        }
    }

    /// Goes on in a stream; returns false if the connection has ended.
    fn acknowledged(&mut self, ack: &Ack, now: Instant) -> bool {
        let Some(mut stream) = self.streams.remove(&ack.stream) else { return true };
        let is_expected = stream.on_its_way.is_some_and(|next| ack.next >= next);
        let mut is_open = true;
        if stream.life == ack.life && is_expected {
            stream.unreleased = stream.on_its_way.take();
            // There may be more.
            is_open = self.send(&ack.stream, &mut stream, now);
        }
        self.streams.insert(ack.stream.clone(), stream);
        self.cloud.set_failing(&self.failing);
        is_open
    }

    /// Looks for new records of all streams, or of those that people read. Returns false if the
    /// connection has ended.
    fn look(&mut self, is_of_all: bool, now: Instant) -> bool {
        if is_of_all {
            self.find_new(now);
        }
        let mut streams = std::mem::take(&mut self.streams);
        let mut is_open = true;
        for (name, stream) in &mut streams {
            let is_due = is_of_all || self.lease.has(name, now);
            is_open = is_open && (!is_due || self.send(name, stream, now));
        }
        self.streams = streams;
        self.cloud.set_failing(&self.failing);
        is_open
    }

    /// Opens streams that did not exist before, or could not be opened.
    fn find_new(&mut self, now: Instant) {
        let (found, listed) = self.spools.streams();
        let Self { streams, failing, .. } = self;
        if listed.is_ok() {
            // The files of one that was removed are open, and its failure would stay.
            streams.retain(|name, _| !failing.contains_key(name) || found.contains(name));
            failing.retain(|name, _| found.contains(name));
        }
        self.note("lambdas", listed.err().as_ref(), now);
        for name in found {
            let is_early = self.failing.get(&name).is_some_and(|it| now < it.tried + UNOPENED);
            if is_early || self.streams.contains_key(&name) {
                continue;
            }
            let open = || self.spools.open(&name);
            match resume(&open, last_part(&name), self.cursors.get(&name)) {
                Ok((life, reader)) => {
                    self.streams.insert(name, SentStream::new(life, reader));
                }
                Err(error) => self.note(&name, Some(&error), now),
            }
        }
    }

    /// Sends a batch of a stream, if one is due and none is on its way. Returns false if the
    /// connection has ended.
    fn send(&mut self, name: &str, stream: &mut SentStream<P::Storage>, now: Instant) -> bool {
        // Without this note, the spool counts more as lost than was. A disk that does not take it
        // may still be read.
        let released = stream.release();
        if stream.on_its_way.is_some() {
            return true;
        }
        let is_read = self.lease.has(name, now);
        let (batch, read) = match stream.waits.take() {
            None => stream.batch(name, is_read, now),
            batch => (batch, Ok(())),
        };
        self.note(name, read.and(released).err().as_ref(), now);
        let Some(batch) = batch else { return true };
        if !self.rate.take(batch.lines.len() as f64, now) {
            stream.waits = Some(batch);
            return true;
        }
        let Batch { lines, next } = batch;
        stream.on_its_way = Some(next);
        let records = Records { stream: name.to_owned(), life: stream.life, next, lines };
        self.out.blocking_send(Body::Records(records)).is_ok()
    }

    /// Notes the outcome of a try. A failure is logged, unless the try before has failed, too.
    fn note<E: Error + 'static>(&mut self, name: &str, error: Option<&E>, now: Instant) {
        let failing = &mut self.failing;
        let Some(error) = error else {
            failing.remove(name);
            return;
        };
        let mut root: &dyn Error = error;
        while let Some(source) = root.source() {
            root = source;
        }
        let (cause, text) = (root.to_string(), chain(error));
        let before = failing.remove(name);
        if before.is_none() {
            tracing::warn!(stream = name, error = text, "cannot send a stream; will retry");
        }
        let since = before.map_or(now, |it| it.since);
        failing.insert(name.to_owned(), FailedTry { cause, text, since, tried: now });
    }
}

impl<S: SpoolStorage> SentStream<S> {
    fn new(life: u64, mut reader: SpoolReader<S>) -> Self {
        reader.keep_durable();
        Self {
            life,
            batched: reader.position(),
            // Also back, if the spool has lost records that the cloud has.
            unreleased: Some(reader.position().unwrap_or(0)),
            reader,
            collected: CollectedLines::default(),
            is_behind: true,
            waits: None,
            on_its_way: None,
        }
    }

    /// Notes in the spool what the cloud has.
    fn release(&mut self) -> Result<(), SpoolError> {
        if let Some(before) = self.unreleased {
            self.reader.release(before)?;
            self.unreleased = None;
        }
        Ok(())
    }

    /// Reads the next records; returns those that are due, once they are durable.
    fn batch(
        &mut self,
        name: &str,
        is_read: bool,
        now: Instant,
    ) -> (Option<Batch>, Result<(), SpoolError>) {
        let read = self.collect(last_part(name), now);
        // Lines that were read before a failure do not wait until it ends.
        let is_due = self.is_behind || is_read || read.is_err() || self.collected.is_due(now);
        self.is_behind &= matches!(read, Ok(false));
        if self.collected.count() == 0 && self.batched != self.reader.position() {
            // Nothing of these numbers is sent, such as notes of what the budget has removed.
            self.batched = self.reader.position();
            self.unreleased = self.batched;
        }
        if !is_due || self.collected.count() == 0 {
            return (None, read.map(drop));
        }
        if let Err(error) = self.reader.sync() {
            self.reader.rewind(self.batched);
            self.collected = CollectedLines::default();
            return (None, Err(error));
        }
        self.batched = self.reader.position();
        let batch = self.batched.zip(self.collected.take());
        let batch = batch.map(|(next, lines)| Batch { lines: compress(&lines), next });
        (batch, read.map(drop))
    }

    /// Reads records up to a whole batch; returns whether there are no more for now.
    fn collect(&mut self, name: &str, now: Instant) -> Result<bool, SpoolError> {
        while self.collected.bytes() < BATCH && self.collected.count() < RECORDS_MAX as u64 {
            let item = match self.reader.next() {
                // A commit in progress, or one that a power cut interrupted: a gap follows.
                None | Some(Ok(SpoolItem::Torn(_))) => return Ok(true),
                // The reader has returned these numbers already: as records, or as a gap of its
                // own where they were missing.
                Some(Ok(SpoolItem::Gap(SpoolGap {
                    reason: GapReason::Budget,
                    record: Some(_),
                    ..
                }))) => continue,
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
}

#[cfg(test)]
mod tests;
