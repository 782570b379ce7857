//! Records of a stream that wait to be sent together: time comes from the caller.
//!
//! Without a reader, log lines of a lambda are collected: sent each second by 10,000 vehicles with
//! one chatty lambda each, they would be three times as many batches as a cloud stores. Everything
//! that has news is sent at once, with the lines before it.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use gleaner_fleet::{STREAM_NAME_MAX, TAIL_S, TAIL_STREAMS_MAX, Tail};
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::Value;

/// Interval of looks at streams that people read. The spool of a lambda is written each 200 ms, so
/// that more looks would find nothing.
pub(super) const LIVE_INTERVAL: Duration = Duration::from_millis(200);

/// Bytes of lines that are sent although they are only log lines. Compressed they have 5 to 10 kB,
/// of which the rest of a frame and its transaction are a small part.
const COLLECT_BYTES: usize = 64 << 10;

/// Time after which log lines are sent. 10,000 vehicles with one chatty lambda each send 1,000
/// batches in a second then, a third of what one cloud process stores.
const COLLECT_TIME: Duration = Duration::from_secs(10);

/// Lines of a stream that are not sent yet.
#[derive(Debug, Default)]
pub(super) struct CollectedLines {
    lines: Vec<u8>,
    count: u64,
    /// The time at which the first one was read.
    oldest: Option<Instant>,
    has_news: bool,
}

/// The streams that people read as they come, until a time. It has bounds whatever a cloud sends.
#[derive(Debug, Default, Clone)]
pub(super) struct TailLease {
    streams: BTreeSet<String>,
    until: Option<Instant>,
}

impl CollectedLines {
    /// Adds a line, and its text without a line end.
    pub(super) fn add(&mut self, line: &StreamLine, text: &[u8], now: Instant) {
        self.lines.extend(text);
        self.lines.push(b'\n');
        self.count += 1;
        self.oldest.get_or_insert(now);
        self.has_news |= has_news(line);
    }

    /// Returns whether they are to be sent without a reader.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        self.has_news
            || self.lines.len() >= COLLECT_BYTES
            || self.oldest.is_some_and(|oldest| now.duration_since(oldest) >= COLLECT_TIME)
    }

    /// Returns the lines, if there are some; afterwards there are none.
    pub(super) fn take(&mut self) -> Option<Vec<u8>> {
        let Self { lines, count, .. } = std::mem::take(self);
        (count > 0).then_some(lines)
    }

    pub(super) fn bytes(&self) -> usize {
        self.lines.len()
    }

    pub(super) fn count(&self) -> u64 {
        self.count
    }
}

impl TailLease {
    pub(super) fn of(tail: Tail, now: Instant) -> Self {
        let streams = tail.streams.into_iter().take(TAIL_STREAMS_MAX);
        let streams = streams.filter(|name| name.len() <= STREAM_NAME_MAX).collect();
        let until = now + Duration::from_secs(tail.seconds.min(TAIL_S).into());
        Self { streams, until: Some(until) }
    }

    pub(super) fn has(&self, stream: &str, now: Instant) -> bool {
        !self.is_over(now) && self.streams.contains(stream)
    }

    /// Returns whether it has no streams, or has ended.
    pub(super) fn is_over(&self, now: Instant) -> bool {
        self.streams.is_empty() || self.until.is_none_or(|until| now >= until)
    }
}

/// Returns whether a record is more than a log line without a warning, or a decision without a
/// trigger, which vehicles keep only if they keep every decision.
fn has_news(line: &StreamLine) -> bool {
    let field = |name: &str| line.record.get(name);
    match &*line.kind {
        "log" => {
            !matches!(field("level").and_then(Value::as_str), Some("info" | "debug" | "trace"))
        }
        "decision" => {
            field("triggers").and_then(Value::as_array).is_none_or(|it| !it.is_empty())
                || field("fault").is_some_and(|fault| !fault.is_null())
        }
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn line(kind: &str, record: Value) -> StreamLine {
        StreamLine {
            stream: "a".to_owned(),
            kind: kind.to_owned(),
            record,
            ..StreamLine::default()
        }
    }

    fn log(level: &str) -> StreamLine {
        line("log", json!({ "at_ns": 1, "level": level, "message": "text" }))
    }

    fn seconds(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn log_lines_wait_until_the_oldest_has_waited_long_or_there_are_many() {
        let start = Instant::now();
        let mut collected = CollectedLines::default();
        assert!(!collected.is_due(start + seconds(100)), "there is nothing");
        for second in 0..5 {
            collected.add(&log("info"), b"text", start + seconds(second));
        }
        assert!(!collected.is_due(start + Duration::from_millis(9_999)));
        assert!(collected.is_due(start + COLLECT_TIME));
        assert_eq!(collected.take(), Some(b"text\n".repeat(5)));
        assert_eq!(collected.take(), None);
        // The time of those that were sent does not count for the next one.
        collected.add(&log("debug"), b"text", start + seconds(11));
        assert!(!collected.is_due(start + seconds(12)));
        collected.add(&log("trace"), &[b'x'; COLLECT_BYTES], start + seconds(12));
        assert!(collected.is_due(start + seconds(12)));
    }

    #[test]
    fn what_has_news_takes_the_lines_before_it_along() {
        let start = Instant::now();
        let decision =
            |triggers, fault| line("decision", json!({ "triggers": triggers, "fault": fault }));
        let news = [
            log("warn"),
            log("error"),
            line("log", json!({ "message": "without a level" })),
            decision(json!([{ "label": "dark" }]), Value::Null),
            decision(json!([]), json!({ "kind": "fuel" })),
            line("decision", Value::Null),
        ];
        let kinds = ["started", "ended", "gap", "damaged", "lost", "event", "of another version"];
        for line in kinds.map(|kind| line(kind, json!({}))).into_iter().chain(news) {
            let mut collected = CollectedLines::default();
            collected.add(&log("info"), b"before", start);
            collected.add(&decision(json!([]), Value::Null), b"and this", start);
            assert!(!collected.is_due(start));
            collected.add(&line, b"news", start);
            collected.add(&log("info"), b"after", start);
            assert!(collected.is_due(start), "{line:?}");
            assert_eq!(collected.take().unwrap(), b"before\nand this\nnews\nafter\n");
        }
    }

    #[test]
    fn a_lease_ends_and_has_bounds_whatever_a_cloud_sends() {
        let start = Instant::now();
        let lease = |streams: Vec<String>, seconds| TailLease::of(Tail { streams, seconds }, start);
        let short = lease(vec!["events".to_owned()], 5);
        assert!(short.has("events", start + seconds(4)) && !short.has("orchestrator", start));
        assert!(!short.has("events", start + seconds(5)) && short.is_over(start + seconds(5)));
        let long = lease(vec!["events".to_owned()], u32::MAX);
        assert!(long.has("events", start + seconds(59)) && long.is_over(start + seconds(60)));
        assert!(lease(vec!["events".to_owned()], 0).is_over(start));
        assert!(lease(Vec::new(), 60).is_over(start) && TailLease::default().is_over(start));
        let many = lease((0..100_000).map(|it| it.to_string()).collect(), 60);
        assert_eq!(many.streams.len(), TAIL_STREAMS_MAX);
        assert!(lease(vec!["x".repeat(1 << 20)], 60).is_over(start));
    }
}
