//! Records of spools as lines of JSON.

use std::collections::VecDeque;
use std::path::Path;
use std::time::Duration;

use axum::body::{Body, Bytes};
use gleaner_base::{Exit, Failure, hex};
use gleaner_protocol::vehicle_api::StreamLine;
use gleaner_spool::{SpoolItem, SpoolReader};
use serde_json::{Value, json};
use tokio::sync::mpsc;

use crate::api::StreamQuery;

/// Interval of looks for new records.
const INTERVAL: Duration = Duration::from_millis(100);
/// Number of pieces that wait for a slow client; then reading waits.
const QUEUE: usize = 16;
/// Number of lines in a piece.
const PIECE: usize = 256;
/// Maximum of `last`.
const LAST_MAX: usize = 10_000;

/// Returns the lines of the streams `names` in the folder `spool`, those of several by time.
///
/// # Errors
///
/// A failure if a stream cannot be read.
pub(crate) fn lines(spool: &Path, names: &[&str], query: &StreamQuery) -> Result<Body, Failure> {
    if names.len() > 1 && query.from.is_some() {
        let message = "`from` counts records of one stream, and these are several";
        return Err(Failure::new(Exit::Usage, message).with_help("use `last`"));
    }
    let mut readers = Vec::new();
    for name in names {
        let folder = spool.join(name);
        // Nothing was written yet.
        if folder.is_dir() {
            let reader = SpoolReader::open(&folder, name, query.from);
            let reader = reader.map_err(|it| Failure::because("cannot read a stream", &it))?;
            readers.push((reader, (*name).to_owned()));
        }
    }
    let (sender, mut pieces) = mpsc::channel::<Bytes>(QUEUE);
    let (last, follow) = (query.last.map(|last| last.min(LAST_MAX)), query.follow);
    tokio::task::spawn_blocking(move || send(readers, last, follow, &sender));
    let stream = futures_util::stream::poll_fn(move |context| pieces.poll_recv(context));
    Ok(Body::from_stream(futures_util::StreamExt::map(stream, Ok::<_, std::convert::Infallible>)))
}

/// Sends lines until the end, or until the client closes the connection.
fn send(
    mut readers: Vec<(SpoolReader, String)>,
    mut last: Option<usize>,
    follow: bool,
    to: &mpsc::Sender<Bytes>,
) {
    loop {
        let is_first = last.is_some();
        let mut round = VecDeque::new();
        for (reader, name) in &mut readers {
            let mut kept = VecDeque::new();
            for item in reader.by_ref() {
                kept.push_back(line(name, item));
                match last {
                    Some(last) if kept.len() > last => {
                        kept.pop_front();
                    }
                    None if kept.len() >= PIECE && !follow => {
                        if !send_piece(&mut kept, to) {
                            return;
                        }
                    }
                    _ => {}
                }
            }
            round.extend(kept);
        }
        round.make_contiguous().sort_by_key(|line| line.time_ns);
        if let Some(last) = last.take() {
            round.drain(..round.len().saturating_sub(last));
        }
        while !round.is_empty() {
            let mut piece: VecDeque<_> = round.drain(..round.len().min(PIECE)).collect();
            if !send_piece(&mut piece, to) {
                return;
            }
        }
        if !follow || to.is_closed() {
            return;
        }
        if !is_first {
            std::thread::sleep(INTERVAL);
        }
    }
}

fn send_piece(lines: &mut VecDeque<StreamLine>, to: &mpsc::Sender<Bytes>) -> bool {
    let mut text = Vec::new();
    for line in lines.drain(..) {
        serde_json::to_writer(&mut text, &line).expect("a line is plain data");
        text.push(b'\n');
    }
    to.blocking_send(text.into()).is_ok()
}

fn line(stream: &str, item: Result<SpoolItem, gleaner_spool::SpoolError>) -> StreamLine {
    let empty = |seq, record| StreamLine {
        stream: stream.to_owned(),
        seq,
        time_ns: 0,
        boot_ns: 0,
        boot: String::new(),
        record,
    };
    match item {
        Ok(SpoolItem::Record(record)) => StreamLine {
            time_ns: record.time.wall_ns,
            boot_ns: record.time.since_boot_ns,
            boot: hex(&record.boot.0),
            ..empty(record.seq, content(&record.payload))
        },
        Ok(SpoolItem::Gap(gap)) => {
            let (to, reason) = (gap.to, format!("{:?}", gap.reason));
            empty(gap.from, json!({ "kind": "gap", "to": to, "reason": reason }))
        }
        Ok(SpoolItem::Torn(torn)) => {
            empty(torn.from, json!({ "kind": "torn", "bytes": torn.bytes }))
        }
        Err(error) => empty(0, json!({ "kind": "error", "text": gleaner_base::chain(&error) })),
    }
}

fn content(payload: &[u8]) -> Value {
    serde_json::from_slice(payload)
        .unwrap_or_else(|error| json!({ "kind": "unknown", "text": error.to_string() }))
}
