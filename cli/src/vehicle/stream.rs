//! `gleaner logs` and `gleaner events`: print records of a vehicle.

use gleaner_base::text::list;
use gleaner_base::{Exit, Failure, UtcTime, in_one_line, visible};
use gleaner_protocol::vehicle_api::{StreamLine, in_order};
use serde_json::Value;

use super::client::VehicleClient;
use super::deploy::checked_id;
use crate::args::{LogsArgs, StreamArgs};
use crate::output::{end_with_reader, print, print_json};
use crate::render::Paint;

/// Length of records, as JSON, that are kept in memory to sort them; a longer list is sorted in
/// parts.
const SORTED_MAX: usize = 64 << 20;

pub(crate) fn logs(args: &LogsArgs) -> Result<Exit, Failure> {
    let path = format!("/v1/lambdas/{}/records", checked_id(&args.id)?);
    let client = VehicleClient::of(&args.stream.source)?;
    // The records of a removed deployment stay for a while.
    let check = || check_deployed(&client, &args.id);
    let shows_none = args.stream.follow || args.stream.last == 0;
    if shows_none && is_empty(&client, &path)? {
        check()?;
    }
    let count = show(&client, &path, &args.stream)?;
    if count == 0 && !shows_none {
        check()?;
    }
    Ok(Exit::Ok)
}

pub(crate) fn events(args: &StreamArgs) -> Result<Exit, Failure> {
    show(&VehicleClient::of(&args.source)?, "/v1/events", args).map(|_| Exit::Ok)
}

/// Refuses the id of a deployment that the vehicle does not have.
fn check_deployed(client: &VehicleClient, id: &str) -> Result<(), Failure> {
    let ids: Vec<_> = client.status()?.deployments.into_iter().map(|it| visible(&it.id)).collect();
    if ids.iter().any(|it| it == id) {
        return Ok(());
    }
    let message = format!("there is no deployment `{id}`, and no record of one");
    let help = match ids.is_empty() {
        true => "nothing is deployed there".to_owned(),
        false => format!("the deployments are {}", list(&ids, "and")),
    };
    Err(Failure::new(Exit::Usage, message).with_help(help))
}

fn is_empty(client: &VehicleClient, path: &str) -> Result<bool, Failure> {
    let mut is_empty = true;
    client.lines(&format!("{path}?last=1&follow=false"), |_| {
        is_empty = false;
        Ok(())
    })?;
    Ok(is_empty)
}

/// Records that are printed in order.
#[derive(Default)]
struct ListedRecords {
    lines: Vec<StreamLine>,
    bytes: usize,
}

impl ListedRecords {
    fn print(&mut self, paint: Paint) -> Result<(), Failure> {
        let lines = in_order(std::mem::take(self).lines, |line| line.into());
        lines.iter().try_for_each(|line| print(&record_text(line, paint)))
    }
}

/// Prints records; returns their number. A list is sorted by boots of the machine and the time
/// since each; records that are followed, and JSON for programs, come as they arrived.
fn show(client: &VehicleClient, path: &str, args: &StreamArgs) -> Result<u64, Failure> {
    let path = format!("{path}?last={}&follow={}", args.last, args.follow);
    let paint = Paint::of_stdout();
    if args.follow {
        end_with_reader();
    }
    let (mut listed, mut count) = (ListedRecords::default(), 0);
    let read = client.lines(&path, |text| {
        let failed = |error: serde_json::Error| {
            Failure::caused_by(Exit::Internal, "cannot parse a record", &error)
        };
        count += 1;
        if args.source.vehicle.json {
            return print_json(&serde_json::from_str::<Value>(text).map_err(failed)?).map(drop);
        }
        let line: StreamLine = serde_json::from_str(text).map_err(failed)?;
        if args.follow {
            return print(&record_text(&line, paint));
        }
        listed.bytes += text.len();
        listed.lines.push(line);
        if listed.bytes > SORTED_MAX { listed.print(paint) } else { Ok(()) }
    });
    listed.print(paint)?;
    let ended = Failure::new(Exit::Unreachable, "the stream has ended");
    let ended = ended.with_help("start this command again to follow it further");
    read.and(if args.follow { Err(ended) } else { Ok(count) })
}

pub(crate) fn record_text(line: &StreamLine, paint: Paint) -> String {
    let record = &line.record;
    let field = |name: &str| record.get(name).and_then(Value::as_str).map(visible);
    let time = match line.time_ns {
        0 => format!("{:24}", "no time"),
        time_ns => time(time_ns),
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
    let reason = gap_reason(record.get("reason").and_then(Value::as_str).unwrap_or_default());
    format!("records {first} to {last} are missing: {reason}")
}

pub(super) fn gap_reason(reason: &str) -> &'static str {
    match reason {
        "Budget" | "Retention" => "newer ones took their room",
        "DiskFull" => "the disk was full",
        "WriteFailed" => "writing to the disk failed",
        "QueueFull" => "there were too many at once",
        "Torn" => "a kill or a power cut, and some were never used",
        "Damaged" => "their bytes were changed",
        _ => "no file has them",
    }
}

/// Formats a time in the form of RFC 3339, in UTC, with ms.
fn time(time_ns: i64) -> String {
    let seconds = UtcTime::of(time_ns.div_euclid(1_000_000_000)).to_string();
    let ms = time_ns.rem_euclid(1_000_000_000) / 1_000_000;
    format!("{}.{ms:03}Z", seconds.trim_end_matches('Z'))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn shown(time_ns: i64, kind: &str, record: Value) -> String {
        let stream = "a".to_owned();
        let (kind, boot) = (kind.to_owned(), String::new());
        let line = StreamLine { stream, seq: 7, time_ns, boot_ns: 0, boot, kind, record };
        record_text(&line, Paint::new(false))
    }

    #[test]
    fn a_record_has_its_date_and_zone() {
        let event = json!({ "event": "ready", "lambda": "a", "text": "ready" });
        let line = shown(1_533_199_491_136_000_000, "event", event);
        assert_eq!(line, "2018-08-02T08:44:51.136Z ready        a: ready\n");
    }

    #[test]
    fn a_gap_has_both_numbers_and_the_reason() {
        let gap = shown(0, "gap", json!({ "to": 9, "reason": "DiskFull" }));
        let expected = "records 7 to 9 are missing: the disk was full\n";
        assert_eq!(gap, format!("no time                  gap          {expected}"));
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
