//! Sends the records of all streams that the cloud does not have: a thread for each connection.
//!
//! Of each stream one batch is on its way at a time, and the next one follows when the cloud has
//! made it durable. A connection that is lost loses nothing: the next one goes on after the last
//! record that the cloud has.

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
    pub(super) acks: Receiver<Ack>,
}

/// A stream that is sent.
struct SentStream {
    life: u64,
    reader: SpoolReader,
    /// A batch that the rate does not allow yet.
    waits: Option<Batch>,
    /// The number after those that are on their way, and their count.
    on_its_way: Option<(u64, u64)>,
    /// True once it could not be read.
    is_unreadable: bool,
}

/// A batch of records.
struct Batch {
    lines: Vec<u8>,
    count: u64,
    next: u64,
}

impl Uplink {
    /// Runs until the connection ends.
    pub(super) fn run(self) {
        let mut streams: BTreeMap<String, SentStream> = BTreeMap::new();
        let mut rate = RATE;
        let mut look_at = Instant::now();
        while !self.out.is_closed() {
            match self.acks.recv_timeout(look_at.saturating_duration_since(Instant::now())) {
                Ok(ack) => {
                    let stream = streams.get_mut(&ack.stream).filter(|it| it.life == ack.life);
                    if let Some(stream) = stream
                        && stream.on_its_way.is_some_and(|(next, _)| ack.next >= next)
                    {
                        stream.on_its_way = None;
                        // There may be more.
                        if !self.send(&ack.stream, stream, &mut rate) {
                            return;
                        }
                    }
                }
                Err(RecvTimeoutError::Timeout) => {
                    look_at = Instant::now() + INTERVAL;
                    self.find_new(&mut streams);
                    let mut all = streams.iter_mut();
                    if !all.all(|(name, stream)| self.send(name, stream, &mut rate)) {
                        return;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
            let on_their_way = streams.values().filter_map(|it| it.on_its_way);
            self.cloud.lock().unsent = on_their_way.map(|(_, count)| count).sum();
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
            let stream =
                SentStream { life, reader, waits: None, on_its_way: None, is_unreadable: false };
            streams.insert(name, stream);
        }
    }

    /// Sends a batch of a stream, if there is one and none is on its way. Returns false if the
    /// connection has ended.
    fn send(&self, name: &str, stream: &mut SentStream, rate: &mut RateLimit) -> bool {
        if stream.on_its_way.is_some() {
            return true;
        }
        let Some(batch) = stream.waits.take().or_else(|| stream.batch(name)) else { return true };
        if !rate.take(batch.lines.len() as f64, Instant::now()) {
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
    /// Reads the next records.
    fn batch(&mut self, name: &str) -> Option<Batch> {
        let name = last_part(name);
        let (mut text, mut count) = (Vec::new(), 0);
        while text.len() < BATCH && count < RECORDS_MAX as u64 && !self.is_unreadable {
            let item = match self.reader.next() {
                // A commit in progress, or one that a power cut interrupted: a gap follows.
                None | Some(Ok(SpoolItem::Torn(_))) => break,
                Some(item) => item,
            };
            if let Err(error) = &item {
                tracing::warn!(stream = name, error = chain(error), "a stream cannot be sent");
                self.is_unreadable = true;
                break;
            }
            let mut line = line(name, item);
            let mut encoded = serde_json::to_vec(&line).expect("a line is plain data");
            if encoded.len() > FRAME_MAX / 2 {
                let text = format!("a record of {} bytes is too long to be sent", encoded.len());
                (line.kind, line.record) = ("damaged".to_owned(), json!({ "text": text }));
                encoded = serde_json::to_vec(&line).expect("a line is plain data");
            }
            text.extend(encoded);
            text.push(b'\n');
            count += 1;
        }
        let next = self.reader.position().filter(|_| count > 0)?;
        Some(Batch { lines: compress(&text), count, next })
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
