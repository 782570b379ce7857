//! `gleaner logs` and `gleaner events`: print records of a vehicle.

use gleaner_base::{Exit, Failure, visible};
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::Value;

use super::client::VehicleClient;
use crate::args::{LogsArgs, StreamArgs};
use crate::render::{Paint, time_of_day};
use crate::stdout::{end_with_reader, print};

/// Runs `gleaner logs`.
pub(crate) fn logs(args: &LogsArgs) -> Result<Exit, Failure> {
    if args.id.parse::<gleaner_lambda::manifest::ItemName>().is_err() {
        let id = gleaner_base::excerpt(&args.id);
        return Err(Failure::new(Exit::Usage, format!("`{id}` is no id of a deployment"))
            .with_help("`gleaner status` lists them"));
    }
    show(&format!("/v1/lambdas/{}/records", args.id), &args.stream)
}

/// Runs `gleaner events`.
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
        print(&text(&line, paint))
    })?;
    Ok(Exit::Ok)
}

/// Formats a record as a line.
fn text(line: &StreamLine, paint: Paint) -> String {
    let record = &line.record;
    let field = |name: &str| record.get(name).and_then(Value::as_str).map(visible);
    let time = match line.time_ns {
        0 => "--:--:--.---".to_owned(),
        time => time_of_day(time),
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
        words.push(format!("fault {}: {}", text(fault, "kind"), text(fault, "message")));
    }
    if words.is_empty() { "nothing".to_owned() } else { words.join(", ") }
}
