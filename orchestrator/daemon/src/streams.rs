//! Records of spools as lines of JSON.

use std::collections::VecDeque;
use std::path::Path;
use std::time::Duration;

use axum::body::{Body, Bytes};
use gleaner_base::{Exit, Failure, chain, hex};
use gleaner_protocol::SpooledRecord;
use gleaner_protocol::vehicle_api::StreamLine;
use gleaner_spool::{SpoolItem, SpoolReader, SpoolRecord};
use serde_json::{Value, json};
use tokio::sync::mpsc;

use crate::api::StreamQuery;

/// The streams of events.
pub(crate) const STREAMS: [&str; 2] = ["events", "orchestrator"];
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
    let line = |seq, kind: &str, record| StreamLine {
        stream: stream.to_owned(),
        seq,
        time_ns: 0,
        boot_ns: 0,
        boot: String::new(),
        kind: kind.to_owned(),
        record,
    };
    match item {
        Ok(SpoolItem::Record(record)) => {
            let (kind, content) = content(stream, &record);
            StreamLine {
                time_ns: record.time.wall_ns,
                boot_ns: record.time.since_boot_ns,
                boot: hex(&record.boot.0),
                ..line(record.seq, &kind, content)
            }
        }
        Ok(SpoolItem::Gap(gap)) => {
            let reason = format!("{:?}", gap.reason);
            line(gap.from, "gap", json!({ "to": gap.to, "reason": reason }))
        }
        Ok(SpoolItem::Torn(torn)) => line(torn.from, "torn", json!({ "bytes": torn.bytes })),
        Err(error) => line(0, "damaged", json!({ "text": chain(&error) })),
    }
}

/// Returns the kind and the content of a record.
fn content(stream: &str, record: &SpoolRecord) -> (String, Value) {
    let damaged = |text: String| ("damaged".to_owned(), json!({ "text": text }));
    if STREAMS.contains(&stream) {
        let event = serde_json::from_slice(&record.payload);
        return event.map_or_else(|it| damaged(it.to_string()), |it| ("event".to_owned(), it));
    }
    let parsed = SpooledRecord::parse(record.kind, &record.payload);
    match parsed.map(|it| serde_json::to_value(it).expect("a record has only text keys")) {
        Ok(mut value) => {
            let content = value.get_mut("record").map_or(Value::Null, Value::take);
            let kind = value.get("kind").and_then(Value::as_str).unwrap_or_default();
            (kind.to_owned(), content)
        }
        Err(error) => damaged(chain(&error)),
    }
}
