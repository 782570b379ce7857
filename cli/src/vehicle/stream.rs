//! `gleaner logs` and `gleaner events`: print records of a vehicle.

use std::time::SystemTime;

use gleaner_base::{Exit, Failure, UtcTime, in_one_line, nanoseconds, visible};
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::Value;

use super::client::VehicleClient;
use crate::args::{LogsArgs, StreamArgs};
use crate::render::{Paint, time_of_day};
use crate::stdout::{end_with_reader, print};

pub(crate) fn logs(args: &LogsArgs) -> Result<Exit, Failure> {
    if args.id.parse::<gleaner_lambda::manifest::ItemName>().is_err() {
        let id = gleaner_base::excerpt(&args.id);
        return Err(Failure::new(Exit::Usage, format!("`{id}` is no id of a deployment"))
            .with_help("`gleaner status` lists them"));
    }
    show(&format!("/v1/lambdas/{}/records", args.id), &args.stream)
}

pub(crate) fn events(args: &StreamArgs) -> Result<Exit, Failure> {
    show("/v1/events", args)
}

fn show(path: &str, args: &StreamArgs) -> Result<Exit, Failure> {
    let client = VehicleClient::of(&args.vehicle, &args.on)?;
    let path = format!("{path}?last={}&follow={}", args.last, args.follow);
    let paint = Paint::of_stdout();
    if args.follow {
        end_with_reader();
    }
    client.lines(&path, |line| {
        if args.vehicle.json {
            return print(&format!("{line}\n"));
        }
        let line: StreamLine = serde_json::from_str(line)
            .map_err(|error| Failure::caused_by(Exit::Internal, "cannot parse a record", &error))?;
        print(&record_text(&line, paint))
    })?;
    Ok(Exit::Ok)
}

/// Formats a record as a line, with its date unless that is today.
pub(crate) fn record_text(line: &StreamLine, paint: Paint) -> String {
    let since_1970 = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
    text(line, &date(nanoseconds(since_1970)), paint)
}

/// Formats a record as a line, with its date unless that is `today`.
fn text(line: &StreamLine, today: &str, paint: Paint) -> String {
    let record = &line.record;
    let field = |name: &str| record.get(name).and_then(Value::as_str).map(visible);
    let time = match line.time_ns {
        0 => "--:--:--.---".to_owned(),
        time => match date(time) {
            day if day == *today => time_of_day(time),
            day => format!("{day} {}", time_of_day(time)),
        },
    };
    let kind = field("event").unwrap_or_else(|| visible(&line.kind));
    let lambda = field("lambda").map(|it| format!("{it}: ")).unwrap_or_default();
    let words = match &*line.kind {
        "event" => lambda + &field("text").unwrap_or_default(),
        "log" => {
            let level = field("level").unwrap_or_default();
            format!("{level}: {}", field("message").unwrap_or_default())
        }
        "decision" => decision_words(record),
        "gap" => gap_words(line.seq, record),
        "damaged" if record.get("records").is_some() => {
            let to = record.get("to").and_then(Value::as_u64).unwrap_or(line.seq);
            let reason = field("reason").unwrap_or_default();
            format!("records {} to {to} are missing: {reason}", line.seq)
        }
        "started" => format!("process of revision {}", field("revision").unwrap_or_default()),
        _ => record.to_string(),
    };
    let shown = match &*kind {
        "failed" | "quarantined" | "refused" | "loss" | "lost" | "gap" | "torn" | "damaged" => {
            paint.red(&words)
        }
        "warning" | "rolled_back" | "omitted" => paint.yellow(&words),
        "decision" => paint.green(&words),
        _ => words,
    };
    format!("{} {kind:<12} {shown}\n", paint.dim(&time))
}

/// Returns the triggers and the fault of a decision.
fn decision_words(record: &Value) -> String {
    let text = |value: &Value, name: &str| {
        value.get(name).and_then(Value::as_str).map(visible).unwrap_or_default()
    };
    let triggers = record.get("triggers").and_then(Value::as_array).into_iter().flatten();
    let mut words: Vec<_> = triggers.map(|trigger| text(trigger, "label")).collect();
    if let Some(fault) = record.get("fault").filter(|fault| !fault.is_null()) {
        let message = fault.get("message").and_then(Value::as_str).unwrap_or_default();
        words.push(format!("fault {}: {}", text(fault, "kind"), in_one_line(message)));
        // The whole of a traceback.
        let more = message.lines().filter(|_| message.trim_end().contains('\n'));
        let more: String = more.map(|line| format!("\n    {}", visible(line))).collect();
        return words.join(", ") + &more;
    }
    if words.is_empty() { "nothing".to_owned() } else { words.join(", ") }
}

/// Returns the numbers of records that are missing from `first` on, and the reason.
fn gap_words(first: u64, record: &Value) -> String {
    let last = record.get("to").and_then(Value::as_u64).unwrap_or(first);
    let reason = match record.get("reason").and_then(Value::as_str).unwrap_or_default() {
        "Budget" | "Retention" => "newer ones took their room",
        "DiskFull" => "the disk was full",
        "WriteFailed" => "writing to the disk failed",
        "QueueFull" => "there were too many at once",
        "Torn" => "a kill or a power cut, and some were never used",
        "Damaged" => "their bytes were changed",
        _ => "no file has them",
    };
    format!("records {first} to {last} are missing: {reason}")
}

/// Returns the day of a time, in UTC.
fn date(time_ns: i64) -> String {
    let text = UtcTime::of(time_ns.div_euclid(1_000_000_000)).to_string();
    text.split('T').next().unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn shown(time_ns: i64, kind: &str, record: Value) -> String {
        let stream = "a".to_owned();
        let (kind, boot) = (kind.to_owned(), String::new());
        let line = StreamLine { stream, seq: 7, time_ns, boot_ns: 0, boot, kind, record };
        text(&line, "2018-08-02", Paint::new(false))
    }

    #[test]
    fn a_record_of_another_day_has_its_date() {
        let event = || json!({ "event": "ready", "lambda": "a", "text": "ready" });
        let now = 1_533_199_491_136_000_000;
        assert_eq!(shown(now, "event", event()), "08:44:51.136 ready        a: ready\n");
        let before = shown(now - 86_400_000_000_000, "event", event());
        assert_eq!(before, "2018-08-01 08:44:51.136 ready        a: ready\n");
    }

    #[test]
    fn a_gap_has_both_numbers_and_the_reason() {
        let gap = shown(0, "gap", json!({ "to": 9, "reason": "DiskFull" }));
        let expected = "records 7 to 9 are missing: the disk was full\n";
        assert_eq!(gap, format!("--:--:--.--- gap          {expected}"));
    }

    #[test]
    fn a_fault_is_its_last_line_and_then_the_whole_traceback() {
        let message = "Traceback (most recent call last):\n  File \"main.py\"\nValueError: no";
        let fault = json!({ "triggers": [], "fault": { "kind": "exception", "message": message } });
        let lines = shown(0, "decision", fault);
        let lines: Vec<_> = lines.lines().collect();
        assert!(lines[0].ends_with("fault exception: ValueError: no"), "{lines:?}");
        assert_eq!(lines[2..], ["      File \"main.py\"", "    ValueError: no"]);
        let one = json!({ "triggers": [], "fault": { "kind": "fuel", "message": "too much" } });
        assert!(shown(0, "decision", one).ends_with("fault fuel: too much\n"));
    }
}
