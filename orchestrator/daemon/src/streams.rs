//! Records of spools as lines of JSON.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axum::body::{Body, Bytes};
use gleaner_base::{Exit, Failure, chain, hex};
use gleaner_protocol::SpooledRecord;
use gleaner_protocol::vehicle_api::StreamLine;
use gleaner_spool::{SpoolItem, SpoolReader, SpoolRecord};
use serde_json::{Value, json};
use tokio::sync::mpsc;

use crate::api::StreamQuery;

pub(crate) const STREAMS: [&str; 2] = ["events", "orchestrator"];
/// Interval of looks for new records.
const INTERVAL: Duration = Duration::from_millis(100);
/// Number of pieces that wait for a slow client; then reading waits.
const QUEUE: usize = 16;
/// Number of lines in a piece.
const PIECE: usize = 256;
/// Maximum number of streams that are read at a time.
const OPEN_MAX: usize = 32;
const LAST_MAX: usize = 10_000;

/// Returns the lines of the streams `names` in the folder `spool`, those of several by boot and by
/// the time since it.
///
/// # Errors
///
/// A failure if a stream cannot be read.
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
            last: Default::default(),
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
    /// Boot and time of its last record that has them.
    last: (String, u64),
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
            let StreamReader { name, reader: Some(reader), last: before, has_failed, .. } = stream
            else {
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
            round.push(placed(kept, before));
        }
        let mut round = merged(round);
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

/// A line, with the boot and the time since it by which it is ordered.
type PlacedLine = (StreamLine, (String, u64));

/// Gives each line of a stream its place: its own boot and time or, for gaps and damage, those of
/// the record before it. `last` is the place of the last record so far.
fn placed(lines: VecDeque<StreamLine>, last: &mut (String, u64)) -> Vec<PlacedLine> {
    // At the begin of a stream, a gap has the place of the record after it.
    if last.0.is_empty()
        && let Some(first) = lines.iter().find(|line| !line.boot.is_empty())
    {
        *last = (first.boot.clone(), first.boot_ns);
    }
    let place = |line: StreamLine| {
        if !line.boot.is_empty() {
            *last = (line.boot.clone(), line.boot_ns);
        }
        (line, last.clone())
    };
    lines.into_iter().map(place).collect()
}

/// Merges the lines of streams, each of which keeps its order: the time of day may have been set.
fn merged(streams: Vec<Vec<PlacedLine>>) -> VecDeque<StreamLine> {
    let boots = boots(&streams);
    let mut streams: Vec<_> = streams.into_iter().map(|it| it.into_iter().peekable()).collect();
    let mut lines = VecDeque::new();
    loop {
        let first = streams.iter_mut().enumerate().filter_map(|(index, stream)| {
            let (_, (boot, since)) = stream.peek()?;
            Some((boots.iter().position(|it| it == boot), *since, index))
        });
        let Some((.., index)) = first.min() else { return lines };
        lines.extend(streams[index].next().map(|(line, _)| line));
    }
}

/// Returns the boots of all streams in their order. Those of which no stream has two are ordered by
/// the time of day.
fn boots(streams: &[Vec<PlacedLine>]) -> Vec<String> {
    let mut boots: Vec<(String, i64)> = Vec::new();
    for stream in streams {
        let own: Vec<&String> = stream.iter().map(|(_, (boot, _))| boot).collect();
        let mut next = 0;
        for (line, (boot, _)) in stream {
            if let Some(at) = boots.iter().position(|(it, _)| it == boot) {
                next = at + 1;
                continue;
            }
            let is_before =
                |(other, at): &&(String, i64)| !own.contains(&other) && *at <= line.time_ns;
            next += boots[next..].iter().take_while(is_before).count();
            boots.insert(next, (boot.clone(), line.time_ns));
            next += 1;
        }
    }
    boots.into_iter().map(|(boot, _)| boot).collect()
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

    fn stream(name: &str, lines: &[(&str, u64)]) -> VecDeque<StreamLine> {
        let lines = lines.iter().enumerate().map(|(seq, (boot, boot_ns))| StreamLine {
            stream: name.to_owned(),
            seq: seq as u64,
            time_ns: 0,
            boot_ns: *boot_ns,
            boot: (*boot).to_owned(),
            kind: String::new(),
            record: Value::Null,
        });
        lines.collect()
    }

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
                last: Default::default(),
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

    #[test]
    fn streams_are_merged_by_boot_and_time_and_gaps_stay_in_their_place() {
        let gap = ("", 0);
        let events = [gap, ("a", 10), ("a", 30), gap, ("b", 5), ("c", 7)];
        let orchestrator = [("a", 20), ("b", 1), ("b", 6), gap];
        let lasts = &mut [Default::default(), Default::default()];
        let streams = [stream("e", &events), stream("o", &orchestrator)];
        let placed = streams.into_iter().zip(lasts).map(|(lines, last)| placed(lines, last));
        let merged = merged(placed.collect());
        let order: Vec<_> = merged.iter().map(|it| format!("{}{}", it.stream, it.seq)).collect();
        assert_eq!(order, ["e0", "e1", "o0", "e2", "e3", "o1", "e4", "o2", "o3", "e5"]);
    }

    #[test]
    fn boots_of_different_streams_are_ordered_by_the_time_of_day() {
        let at = |boot: &str, time_ns| {
            let mut lines = stream("e", &[(boot, 5)]);
            lines[0].time_ns = time_ns;
            placed(lines, &mut Default::default())
        };
        let of = |streams: [Vec<PlacedLine>; 2]| boots(&streams);
        assert_eq!(of([at("b", 10), at("c", 20)]), ["b", "c"]);
        assert_eq!(of([at("c", 20), at("b", 10)]), ["b", "c"]);
    }
}
