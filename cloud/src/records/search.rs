//! The search for records: over all vehicles or one, the newest first of each vehicle. A request
//! does bounded work, and returns the position from which the next one goes on.

use std::time::{Duration, Instant};

use gleaner_base::excerpt;
use gleaner_fleet::records::{FoundRecord, FoundRecords};
use gleaner_lambda::{LogLevel, LogLine};
use gleaner_protocol::vehicle_api::StreamLine;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::sync::Semaphore;

use super::RecordArchive;
use super::newest::{FoundLine, NewestFirst};
use crate::error::{CloudError, CloudResult};
use crate::request::PageLimit;
use crate::store::{StoredChunk, VehicleFilter, large_line};

/// Bounds of a request: bytes of lines that are looked at, bytes of those that are returned, and
/// the time after which nothing more is begun.
const READ_MAX: u64 = 32 << 20;
const FOUND_MAX: u64 = 4 << 20;
const TIME: Duration = Duration::from_secs(3);
/// Maximum number of streams that are read together. Others of the vehicle follow.
const STREAMS: usize = 32;
/// Longest record that is searched, in bytes: parsed, it takes many times as much memory. A longer
/// one is among the results as a line of kind `large`.
const SEARCHED_MAX: u64 = 256 << 10;
/// Searches that read at a time: more wait for their turn, and do not keep all threads busy.
pub(super) static SEARCHES: Semaphore = Semaphore::const_new(2);
/// Longest text to search for, in bytes.
const TEXT_MAX: usize = 256;
/// The kinds of records, with `trigger` and `fault`, which are decisions with these.
const KINDS: &str = "log, decision, trigger, fault, event, started, summary, ended, lost, omitted, \
                     gap, torn, damaged, large";

/// The least level of records.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub(crate) enum RecordLevel {
    /// Any, also of records without one.
    #[default]
    #[serde(skip)]
    None,
    Trace,
    Debug,
    Info,
    Warn,
    Error,
}

impl RecordLevel {
    pub(crate) fn parse(name: &str) -> Option<Self> {
        let name = serde::de::value::StrDeserializer::<serde::de::value::Error>::new(name);
        Self::deserialize(name).ok()
    }
}

/// A choice of records of all vehicles.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct RecordSearch {
    /// Text in a value of the record, without regard to the case of `A` to `Z`.
    pub(crate) text: Option<String>,
    /// Name of the vehicle.
    pub(crate) vehicle: Option<String>,
    /// Label of the vehicle, as `NAME=VALUE`, or `NAME` with any value.
    pub(crate) label: Option<String>,
    /// Id of a deployment, whose lambda has the records.
    pub(crate) lambda: Option<String>,
    /// Kind of the record, such as `log`, `trigger`, `fault` or `event`.
    pub(crate) kind: Option<String>,
    /// Least level of a log line; a decision with a fault has the level `error`.
    pub(crate) level: Option<RecordLevel>,
    /// Begin and end of the time of the record, in ns since 1970.
    pub(crate) from_ns: Option<i64>,
    pub(crate) to_ns: Option<i64>,
    /// `next` of the part before.
    pub(crate) after: Option<String>,
    /// Maximum number of records in a part.
    #[serde(default)]
    #[schemars(with = "Option<u16>", range(min = 1, max = 500))]
    pub(crate) limit: PageLimit,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct SearchPosition {
    /// The vehicle; empty for the first one.
    vehicle: String,
    /// The first stream of those that are read; empty for the first one.
    stream: String,
    /// The arrival before which records were not looked at. `None` if all of the vehicle were.
    before: Option<i64>,
}

#[derive(Debug, Default)]
pub(super) struct LineFacts {
    pub(super) time_ns: i64,
    pub(super) level: RecordLevel,
    line: Option<StreamLine>,
}

impl LineFacts {
    pub(super) fn of(text: &str) -> Self {
        let Ok(line) = serde_json::from_str::<StreamLine>(text) else { return Self::default() };
        let level = match &*line.kind {
            "log" => LogLine::deserialize(&line.record).map_or(RecordLevel::None, level),
            "decision" if line.record.get("fault").is_some_and(|it| !it.is_null()) => {
                RecordLevel::Error
            }
            _ => RecordLevel::None,
        };
        Self { time_ns: line.time_ns, level, line: Some(line) }
    }
}

fn level(line: LogLine) -> RecordLevel {
    match line.level {
        LogLevel::Error => RecordLevel::Error,
        LogLevel::Warn => RecordLevel::Warn,
        LogLevel::Info => RecordLevel::Info,
        LogLevel::Debug => RecordLevel::Debug,
        LogLevel::Trace => RecordLevel::Trace,
    }
}

struct RecordFilter<'s> {
    search: &'s RecordSearch,
    /// The text in lower case, as it is in a value and as JSON writes it.
    text: String,
    written: String,
}

impl<'s> RecordFilter<'s> {
    fn new(search: &'s RecordSearch) -> CloudResult<Self> {
        let text = search.text.as_deref().unwrap_or_default();
        if text.len() > TEXT_MAX {
            let message = format!("the text to search for has {} bytes", text.len());
            let help = "search for at most 256 bytes";
            return Err(CloudError::usage(message, help));
        }
        if let Some(kind) = &search.kind
            && !KINDS.split(", ").any(|it| it == kind)
        {
            let message = format!("there are no records of kind `{}`", excerpt(kind));
            let help = format!("the kinds are {KINDS}");
            return Err(CloudError::usage(message, &help));
        }
        let quoted = serde_json::to_string(text).unwrap_or_default();
        let written = quoted.trim_matches('"').to_ascii_lowercase();
        Ok(Self { search, text: text.to_ascii_lowercase(), written })
    }

    fn level(&self) -> RecordLevel {
        self.search.level.unwrap_or_default()
    }

    /// Returns whether no record of a chunk can match.
    fn excludes(&self, chunk: &StoredChunk) -> bool {
        let RecordSearch { from_ns, to_ns, .. } = self.search;
        chunk.level < self.level() as i64
            || from_ns.is_some_and(|from| chunk.last_time < from)
            || to_ns.is_some_and(|to| chunk.first_time > to)
    }

    fn has(&self, text: &str) -> bool {
        if !text.to_ascii_lowercase().contains(&self.written) {
            return false;
        }
        let LineFacts { time_ns, level, line } = LineFacts::of(text);
        let Some(line) = line else { return false };
        let RecordSearch { kind, from_ns, to_ns, .. } = self.search;
        let is_in_time = from_ns.is_none_or(|from| time_ns >= from)
            && to_ns.is_none_or(|to| time_ns <= to)
            && (time_ns != 0 || (from_ns.is_none() && to_ns.is_none()));
        is_in_time
            && kind.as_ref().is_none_or(|kind| is_of_kind(&line, kind))
            && level >= self.level()
            && (self.text.is_empty() || self.is_in(&line.record))
    }

    fn is_in(&self, value: &Value) -> bool {
        match value {
            Value::Object(values) => values.values().any(|value| self.is_in(value)),
            Value::Array(values) => values.iter().any(|value| self.is_in(value)),
            Value::String(text) => text.to_ascii_lowercase().contains(&self.text),
            other => other.to_string().contains(&self.text),
        }
    }
}

/// Returns whether a record is of a kind, in the words of the page.
fn is_of_kind(line: &StreamLine, kind: &str) -> bool {
    let has = |field: &str| line.record.get(field).is_some_and(|it| !it.is_null());
    match kind {
        "fault" => line.kind == "decision" && has("fault"),
        "trigger" => {
            let triggers = line.record.get("triggers").and_then(Value::as_array);
            line.kind == "decision" && triggers.is_some_and(|it| !it.is_empty())
        }
        kind => line.kind == kind,
    }
}

struct SearchWork {
    limit: usize,
    items: Vec<FoundRecord>,
    read_bytes: u64,
    found_bytes: u64,
    until: Instant,
}

impl SearchWork {
    fn is_done(&self) -> bool {
        self.items.len() >= self.limit
            || self.read_bytes >= READ_MAX
            || self.found_bytes >= FOUND_MAX
            || Instant::now() >= self.until
    }
}

impl RecordArchive {
    /// Returns the next part of what a search finds.
    pub(crate) async fn search(&self, search: &RecordSearch) -> CloudResult<FoundRecords> {
        let filter = RecordFilter::new(search)?;
        let mut position = match &search.after {
            None => SearchPosition { before: Some(i64::MAX), ..SearchPosition::default() },
            Some(after) => serde_json::from_str(after).map_err(|_| {
                let help = "use `next` of the part before as it is";
                CloudError::usage("`after` is not a position of a search", help)
            })?,
        };
        // It is never closed.
        let _turn = SEARCHES.acquire().await.ok();
        let limit = usize::try_from(u64::from(search.limit)).unwrap_or(1);
        let (items, until) = (Vec::new(), Instant::now() + TIME);
        let mut work = SearchWork { limit, items, read_bytes: 0, found_bytes: 0, until };
        let label = search.label.as_deref().filter(|label| !label.is_empty()).map(|label| {
            let (name, value) = label.split_once('=').unwrap_or((label, ""));
            (name.to_owned(), value.to_owned())
        });
        let vehicles = VehicleFilter {
            only: search.vehicle.clone().unwrap_or_default(),
            label,
            ..VehicleFilter::default()
        };
        if let Some(vehicle) = &search.vehicle {
            self.store.vehicle_exists(vehicle).await?;
        }
        loop {
            let is_begun = position.before.is_some();
            let names = self.store.vehicles_from(&vehicles, &position.vehicle, is_begun).await?;
            let Some(last) = names.last().map(|(name, _)| name.clone()) else { break };
            for (name, is_chosen) in names {
                if position.vehicle != name || position.before.is_none() {
                    let (stream, before) = (String::new(), Some(i64::MAX));
                    position = SearchPosition { vehicle: name, stream, before };
                }
                while is_chosen && position.before.is_some() {
                    if work.is_done() {
                        return Ok(work.found(Some(&position)));
                    }
                    self.search_streams(&filter, &mut work, &mut position).await?;
                }
                position.before = None;
            }
            if work.is_done() {
                return Ok(work.found(Some(&position)));
            }
            position.vehicle = last;
        }
        Ok(work.found(None))
    }

    /// Goes on in some streams of a vehicle, and moves the position. Always makes progress.
    async fn search_streams(
        &self,
        filter: &RecordFilter<'_>,
        work: &mut SearchWork,
        position: &mut SearchPosition,
    ) -> CloudResult<()> {
        let lambda = filter.search.lambda.as_deref().filter(|lambda| !lambda.is_empty());
        let only = lambda.map(|lambda| format!("lambdas/{lambda}"));
        let SearchPosition { vehicle, stream, before } = position.clone();
        let first = only.as_deref().unwrap_or(&stream);
        let mut streams = self.store.streams_from(&vehicle, first, STREAMS + 1).await?;
        if let Some(only) = &only {
            streams.retain(|stream| stream == only);
        }
        let following = (streams.len() > STREAMS).then(|| streams.pop()).flatten();
        let start = before.unwrap_or(i64::MAX);
        let most = work.limit - work.items.len();
        let mut newest = NewestFirst::new(self, &vehicle, streams.into_iter(), (0, start), most);
        newest.longest = i64::try_from(SEARCHED_MAX).unwrap_or(i64::MAX);
        let pick = |stream: &str, found: &mut FoundLine| {
            if found.bytes <= SEARCHED_MAX {
                return filter.has(&found.line);
            }
            found.line = large_line(stream, found.bytes);
            found.bytes = found.line.len() as u64;
            true
        };
        // Less than all streams at the position would not move it.
        while newest.unread_before() == Some(start)
            || (!newest.is_done() && !work.has_no_room(&newest))
        {
            newest.step(|chunk| filter.excludes(chunk), pick).await?;
            tokio::task::yield_now().await;
        }
        work.read_bytes += newest.read_bytes;
        // Older ones may be missing between those that were found.
        let unread = newest.unread_before();
        let mut found = newest.found;
        found.retain(|found| unread.is_none_or(|unread| found.arrival >= unread));
        let is_full = found.len() >= most;
        let last = found.last().map(|found| found.arrival);
        for FoundLine { line, bytes, .. } in found {
            work.found_bytes += bytes;
            if let Ok(line) = serde_json::from_str(&line) {
                work.items.push(FoundRecord { vehicle: vehicle.clone(), line });
            }
        }
        position.before = if is_full { last } else { unread };
        if position.before.is_none()
            && let Some(stream) = following
        {
            (position.stream, position.before) = (stream, Some(i64::MAX));
        }
        Ok(())
    }
}

impl SearchWork {
    /// Returns whether a reader has done what is left of the work.
    fn has_no_room(&self, newest: &NewestFirst<'_>) -> bool {
        let found: u64 = newest.found.iter().map(|found| found.bytes).sum();
        self.read_bytes + newest.read_bytes >= READ_MAX
            || self.found_bytes + found >= FOUND_MAX
            || Instant::now() >= self.until
    }

    fn found(self, position: Option<&SearchPosition>) -> FoundRecords {
        let next = position.and_then(|position| serde_json::to_string(position).ok());
        FoundRecords { items: self.items, next }
    }
}
