//! Records of spools as lines of JSON.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axum::body::{Body, Bytes};
use gleaner_base::{Exit, Failure, chain, hex};
use gleaner_protocol::SpooledRecord;
use gleaner_protocol::vehicle_api::{StreamLine, in_order};
use gleaner_spool::{SpoolItem, SpoolReader, SpoolRecord};
use schemars::JsonSchema;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::mpsc;

use crate::spools::STREAMS;

/// Interval of looks for new records.
const INTERVAL: Duration = Duration::from_millis(100);
/// Number of pieces that wait for a slow client; then reading waits.
const QUEUE: usize = 16;
/// Number of lines in a piece.
const PIECE: usize = 256;
/// Maximum number of streams that are read at a time.
const OPEN_MAX: usize = 32;
const LAST_MAX: usize = 10_000;

/// Choice of the records of a stream.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct StreamQuery {
    /// Number of the first record; without one, the oldest that is kept.
    pub(crate) from: Option<u64>,
    /// Number of the newest records to send instead.
    pub(crate) last: Option<usize>,
    /// True to go on with new records until the client closes the connection.
    #[serde(default)]
    pub(crate) follow: bool,
}

/// Returns the lines of the streams `names` in the folder `spool`, those of several by boot and by
/// the time since it.
pub(crate) fn lines(spool: &Path, names: &[&str], query: &StreamQuery) -> Result<Body, Failure> {
    if names.len() > 1 && query.from.is_some() {
        let message = "`from` counts records of one stream, and these are several";
        return Err(Failure::new(Exit::Usage, message).with_help("use `last`"));
    }
    let slot = StreamSlot::take()?;
    let mut readers: Vec<_> = names
        .iter()
        .map(|name| StreamReader {
            folder: spool.join(name),
            name: (*name).to_owned(),
            from: query.from,
            reader: None,
            has_failed: false,
        })
        .collect();
    readers.iter_mut().try_for_each(StreamReader::open)?;
    let (sender, mut pieces) = mpsc::channel::<Bytes>(QUEUE);
    // Those of several streams are sorted, and thus bounded.
    let most = (names.len() > 1).then_some(LAST_MAX);
    let last = query.last.map(|last| last.min(LAST_MAX)).or(most);
    let follow = query.follow;
    tokio::task::spawn_blocking(move || {
        send(readers, last, follow, &sender);
        drop(slot);
    });
    let stream = futures_util::stream::poll_fn(move |context| pieces.poll_recv(context));
    Ok(Body::from_stream(futures_util::StreamExt::map(stream, Ok::<_, std::convert::Infallible>)))
}

/// A stream that is read. It may not exist before its first record.
struct StreamReader {
    folder: PathBuf,
    name: String,
    from: Option<u64>,
    reader: Option<SpoolReader>,
    /// True if the last look at it ended with an error.
    has_failed: bool,
}

impl StreamReader {
    /// Opens it if it exists, and is not open.
    fn open(&mut self) -> Result<(), Failure> {
        if self.reader.is_none() && self.folder.is_dir() {
            let reader = SpoolReader::open(&self.folder, &self.name, self.from);
            let reader = reader.map_err(|it| Failure::because("cannot read a stream", &it))?;
            self.reader = Some(reader);
        }
        Ok(())
    }
}

/// The right to read a stream; each takes a thread.
struct StreamSlot;

static STREAMS_OPEN: AtomicUsize = AtomicUsize::new(0);

impl StreamSlot {
    fn take() -> Result<Self, Failure> {
        if STREAMS_OPEN.fetch_add(1, Ordering::Relaxed) < OPEN_MAX {
            return Ok(Self);
        }
        drop(Self);
        let message = format!("{OPEN_MAX} streams are read already");
        Err(Failure::new(Exit::Unreachable, message).with_help("end another `gleaner logs -f`"))
    }
}

impl Drop for StreamSlot {
    fn drop(&mut self) {
        STREAMS_OPEN.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Sends lines until the end, or until the client closes the connection.
fn send(
    mut readers: Vec<StreamReader>,
    mut last: Option<usize>,
    follow: bool,
    to: &mpsc::Sender<Bytes>,
) {
    loop {
        let is_first = last.is_some();
        let mut round = Vec::new();
        for stream in &mut readers {
            // A failure is shown by the next request.
            let _ = stream.open();
            let StreamReader { name, reader: Some(reader), has_failed, .. } = stream else {
                continue;
            };
            let mut kept = VecDeque::new();
            for item in reader.by_ref() {
                // It would come without end. The next look tries again, and shows it no more.
                let is_failure = item.is_err();
                if is_failure && *has_failed {
                    break;
                }
                *has_failed = is_failure;
                kept.push_back(line(name, item));
                match last {
                    Some(last) if kept.len() > last => {
                        kept.pop_front();
                    }
                    None if kept.len() >= PIECE && !send_piece(&mut kept, to) => return,
                    _ => {}
                }
                if is_failure {
                    break;
                }
            }
            round.extend(kept);
        }
        let mut round = in_order(round, |line| line.into());
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

pub(crate) fn line(stream: &str, item: Result<SpoolItem, gleaner_spool::SpoolError>) -> StreamLine {
    let line = |seq, kind: &str, record| StreamLine {
        stream: stream.to_owned(),
        seq,
        kind: kind.to_owned(),
        record,
        ..StreamLine::default()
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

#[cfg(test)]
mod tests {
    use std::fs;
    use std::num::NonZeroU8;

    use gleaner_spool::{BUDGET_MIN, BootId, SpoolConfig, SpoolTime, SpoolWriter};

    use super::*;

    #[test]
    fn a_segment_that_cannot_be_read_is_named_once_and_ends_the_list() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events");
        let config =
            SpoolConfig { stream: "events".to_owned(), boot: BootId([1; 16]), budget: BUDGET_MIN };
        let mut writer = SpoolWriter::open(&path, config).unwrap();
        let time = SpoolTime { since_boot_ns: 1, wall_ns: 1 };
        writer.append(NonZeroU8::MIN, time, b"x").unwrap();
        writer.commit().unwrap();
        drop(writer);
        let entries = fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path());
        let segment = entries.into_iter().find(|it| it.extension().is_some_and(|it| it == "seg"));
        let segment = segment.unwrap();
        fs::remove_file(&segment).unwrap();
        fs::create_dir(&segment).unwrap();
        for last in [None, Some(9)] {
            let mut reader = StreamReader {
                folder: path.clone(),
                name: "events".to_owned(),
                from: None,
                reader: None,
                has_failed: false,
            };
            reader.open().unwrap();
            let (to, mut from) = mpsc::channel(9);
            send(vec![reader], last, false, &to);
            drop(to);
            let pieces = std::iter::from_fn(|| from.blocking_recv());
            let text = String::from_utf8(pieces.flatten().collect()).unwrap();
            let lines: Vec<StreamLine> =
                text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
            assert!(lines.len() == 1 && lines[0].kind == "damaged", "{text}");
        }
    }
}
