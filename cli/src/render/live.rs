//! Formats the status of a live lambda and of the recorder, and the list of live topics.

use std::fmt::{self, Write};
use std::time::Duration;

use gleaner_base::visible;
use gleaner_lambda::{Clip, TriggerKind};
use gleaner_protocol::ingress::TopicInfo;
use gleaner_protocol::link::{RecordedTopic, RecorderStatus};
use gleaner_protocol::{DurationStats, LiveStatus, LiveTopic, ReceptionGaps, Report};
use gleaner_report::format::{clip_span, counted, fault_kind, grouped, three_digits};
use serde_json::Value;

use super::{BACKED_OFF, OVER_EVENTS, OVER_RATE, Paint, mib, written};

pub(crate) fn live(live: &LiveStatus, paint: Paint) -> String {
    written(|text| write_live(text, live, paint))
}

pub(crate) fn recorder(status: &RecorderStatus, paint: Paint) -> String {
    written(|text| write_recorder(text, status, paint))
}

/// Returns a report as JSON, with the name of its lambda first. The name that its process reports
/// is not used.
pub(crate) fn named_report(lambda: &str, report: &Report) -> Value {
    let report = serde_json::to_value(report).expect("a report has only text keys");
    let mut named = serde_json::Map::from_iter([("lambda".to_owned(), lambda.into())]);
    if let Value::Object(fields) = report {
        named.extend(fields.into_iter().filter(|(key, _)| key != "lambda"));
    }
    named.into()
}

pub(crate) fn topics(topics: &[TopicInfo]) -> String {
    if topics.is_empty() {
        return "no topics; compare ROS_DOMAIN_ID with that of the nodes, and run `gleaner doctor`\n"
            .to_owned();
    }
    let rows = topics.iter().map(|topic| {
        [
            visible(&topic.topic),
            visible(&topic.type_name),
            topic.writers.to_string(),
            topic.readers.to_string(),
            visible(&topic.qos.join("; ")),
        ]
    });
    table(&["topic", "type", "writers", "readers", "QoS"], rows, &[2, 3])
}

pub(crate) fn clip_line(clip: &Clip, paint: Paint) -> String {
    let [from, to] = clip_span(clip).map(time_of_day);
    written(|text| super::clips::one(text, clip, &format!("{from} to {to}  clip"), paint))
}

/// Formats a decision: a line for each trigger and fault, with `prefix` after the time.
pub(crate) fn decision(decision: &gleaner_lambda::Decision, prefix: &str, paint: Paint) -> String {
    let time = format!("{}  {prefix}", time_of_day(decision.at_ns));
    let mut text = String::new();
    for trigger in &decision.triggers {
        let kind = if trigger.kind == TriggerKind::Event { "" } else { trigger.kind.as_str() };
        let score = trigger.score.map(three_digits).unwrap_or_default();
        let line = format!("{time}{}  {kind}{score}", visible(&trigger.label));
        text += &format!("{}\n", paint.green(line.trim_end()));
    }
    if let Some(fault) = &decision.fault {
        let line = format!(
            "{time}{}: {}",
            fault_kind(fault.kind),
            super::shown(super::gist(&fault.message))
        );
        text += &format!("{}\n", paint.red(&line));
    }
    text
}

fn write_live(text: &mut String, live: &LiveStatus, paint: Paint) -> fmt::Result {
    writeln!(
        text,
        "{} ({}), {:.0} s: {}, {}, {}",
        paint.bold(&format!("{} {}", visible(&live.lambda), visible(&live.version))),
        live.kind.as_str(),
        live.up_s,
        counted(live.wakes, "wake"),
        counted(live.triggers, "trigger"),
        if live.faults > 0 {
            paint.red(&counted(live.faults, "fault"))
        } else {
            counted(live.faults, "fault")
        },
    )?;
    let spreads = [
        ("wake latency", live.wake_latency),
        ("run time", live.run_time),
        ("decision latency", live.decision_latency),
    ];
    let latencies: Vec<String> = spreads
        .iter()
        .filter_map(|(what, spread)| spread.map(|spread| format!("{what} {}", in_ms(&spread, 3))))
        .collect();
    if !latencies.is_empty() {
        writeln!(text, "  {} ms (p50 / p99 / max)", latencies.join(", "))?;
    }
    let head = [
        "input",
        "topic",
        "Hz",
        "received",
        "no slot",
        "too big",
        "overwritten",
        "skipped",
        "newest",
    ];
    let rows = live.topics.iter().map(row);
    write_indented(text, &table(&head, rows, &[2, 3, 4, 5, 6, 7, 8]))?;
    write_gaps(text, live.reception_gaps, paint)?;
    for (count, thing, why) in live_losses(live).into_iter().filter(|(count, ..)| *count > 0) {
        writeln!(text, "  {}", paint.yellow(&format!("lost: {}, {why}", counted(count, thing))))?;
    }
    write_usage(text, live.rss_bytes, live.cpu_s, paint)
}

/// Returns each count of lost data that is not a sample of a topic, with its thing and its cause;
/// also those that are 0.
pub(crate) fn live_losses(live: &LiveStatus) -> [(u64, &'static str, &'static str); 9] {
    let link = live.recorder_link.unwrap_or_default();
    [
        (live.missed_ticks, "tick", "missed"),
        (live.log_dropped, "log line", OVER_RATE),
        (live.triggers_refused, "trigger", OVER_EVENTS),
        (live.backed_off, "wake", BACKED_OFF),
        (live.unwritten, "decision or log line", "not written"),
        (live.unsent, "message", "not sent: a reader of `--rtt` or `--decisions` is too slow"),
        (link.wakes_dropped, "wake", "not sent to the recorder"),
        (link.triggers_lost, "trigger", "not sent to the recorder"),
        (link.recorders_ended, "recorder", "ended: clips lack the time until the next one"),
    ]
}

/// Writes the times in which a process received nothing, if there were any.
fn write_gaps(text: &mut String, gaps: ReceptionGaps, paint: Paint) -> fmt::Result {
    if gaps.count == 0 {
        return Ok(());
    }
    let seconds = Duration::from_millis(gaps.ms).as_secs_f64();
    let times = counted(gaps.count, "time");
    let line = format!("no ingress for {seconds:.1} s: it ended {times}, and was started again");
    writeln!(text, "  {}", paint.yellow(&line))
}

/// Writes the memory of a process in bytes, and its CPU time in s.
fn write_usage(text: &mut String, rss_bytes: u64, cpu_s: f64, paint: Paint) -> fmt::Result {
    let line = format!("{:.1} MiB resident, {cpu_s:.1} s of CPU time", mib(rss_bytes));
    writeln!(text, "  {}", paint.dim(&line))
}

fn write_recorder(text: &mut String, status: &RecorderStatus, paint: Paint) -> fmt::Result {
    let opened = status
        .trigger_to_open
        .map(|spread| format!("; trigger to window {} ms", in_ms(&spread, 3)));
    writeln!(
        text,
        "{}: {}, {}{}; preroll {:.1} of {:.1} MiB{}",
        paint.bold("recorder"),
        counted(status.recording.clips, "clip"),
        counted(status.recording.windows, "window"),
        if status.is_recording { ", recording" } else { "" },
        mib(status.preroll_bytes),
        mib(status.preroll_bound),
        opened.unwrap_or_default(),
    )?;
    let head = ["topic", "received", "no slot", "too big"];
    write_indented(text, &table(&head, status.topics.iter().map(recorded), &[1, 2, 3]))?;
    write_gaps(text, status.reception_gaps, paint)?;
    if let Some(commands) = &status.commands {
        let line = format!(
            "commands on {}: {} accepted, {} refused",
            visible(&commands.topic),
            grouped(commands.accepted),
            grouped(commands.refused)
        );
        writeln!(text, "  {}", if commands.refused > 0 { paint.yellow(&line) } else { line })?;
    }
    super::write_counted(text, &status.recording, paint)?;
    write_usage(text, status.rss_bytes, status.cpu_s, paint)
}

fn recorded(topic: &RecordedTopic) -> [String; 4] {
    [visible(&topic.topic), grouped(topic.received), grouped(topic.no_slot), grouped(topic.too_big)]
}

fn row(topic: &LiveTopic) -> [String; 9] {
    [
        visible(&topic.name),
        visible(&topic.topic),
        format!("{:.1}", topic.rate_hz),
        grouped(topic.received),
        grouped(topic.no_slot),
        grouped(topic.too_big),
        grouped(topic.overwritten),
        grouped(topic.skipped),
        topic
            .age_ns
            .map_or_else(|| "never".to_owned(), |age| format!("{:.3} s ago", age as f64 / 1e9)),
    ]
}

/// Formats p50, p99 and maximum in ms.
pub(crate) fn in_ms(spread: &DurationStats, digits: usize) -> String {
    let ms = |ns: u64| format!("{:.digits$}", ns as f64 / 1e6);
    format!("{} / {} / {}", ms(spread.p50_ns), ms(spread.p99_ns), ms(spread.max_ns))
}

/// Formats a table with a head. Columns are as wide as their widest cell; those in `numbers` are
/// right-aligned.
pub(crate) fn table<R: AsRef<[String]>>(
    head: &[&str],
    rows: impl IntoIterator<Item = R>,
    numbers: &[usize],
) -> String {
    let rows: Vec<R> = rows.into_iter().collect();
    debug_assert!(rows.iter().all(|row| row.as_ref().len() == head.len()));
    let cells = rows.iter().map(|row| row.as_ref().iter().map(String::as_str).collect::<Vec<_>>());
    let lines: Vec<Vec<&str>> = std::iter::once(head.to_vec()).chain(cells).collect();
    let width = |column: usize| lines.iter().map(|line| line[column].chars().count()).max();
    let widths: Vec<usize> = (0..head.len()).map(|column| width(column).unwrap_or(0)).collect();
    let mut text = String::new();
    for line in lines {
        let cells = line.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| {
            match numbers.contains(&column) {
                true => format!("{cell:>width$}"),
                false => format!("{cell:<width$}"),
            }
        });
        text += cells.collect::<Vec<_>>().join("  ").trim_end();
        text.push('\n');
    }
    text
}

pub(crate) fn or_dash<T>(value: Option<T>, text: impl FnOnce(T) -> String) -> String {
    value.map_or_else(|| "-".to_owned(), text)
}

pub(super) fn write_indented(text: &mut String, lines: &str) -> fmt::Result {
    lines.lines().try_for_each(|line| writeln!(text, "  {line}"))
}

/// Formats the time of day, in UTC.
fn time_of_day(at_ns: i64) -> String {
    let ms = at_ns.div_euclid(1_000_000).rem_euclid(86_400_000);
    let (hours, minutes, seconds) = (ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60);
    format!("{hours:02}:{minutes:02}:{seconds:02}.{:03}", ms % 1000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let rows = [["topic", "23"].map(str::to_owned)];
        assert_eq!(table(&["a", "1"], rows, &[1]), "a       1\ntopic  23\n");
    }

    #[test]
    fn control_characters_of_topics_are_escaped() {
        let seen = TopicInfo {
            topic: "/a\u{1b}[2J".to_owned(),
            type_name: "t\u{1b}".to_owned(),
            writers: 1,
            readers: 0,
            qos: vec!["reliable\u{1b}]0;".to_owned()],
        };
        let text = topics(&[seen]);
        assert!(!text.contains('\u{1b}') && text.contains("reliable\\u{1b}]0;"), "{text}");
    }

    #[test]
    fn a_report_names_its_lambda_once() {
        let named = named_report("hello", &Report::Ready);
        assert_eq!(named.to_string(), r#"{"lambda":"hello","report":"ready"}"#);
        let text = r#"{"report":"isolation","layers":[],"lambda":"other"}"#;
        let report: Report = serde_json::from_str(text).unwrap();
        let named = named_report("hello", &report).to_string();
        assert_eq!(named, r#"{"lambda":"hello","report":"isolation","layers":[]}"#);
        assert_eq!(serde_json::from_str::<Report>(&named).unwrap(), report);
    }

    #[test]
    fn the_time_of_day_is_utc() {
        assert_eq!(time_of_day(1_533_199_491_136_999_999), "08:44:51.136");
    }
}
