//! `gleaner logs` and `gleaner events`: print records of a vehicle.

use gleaner_base::{Exit, Failure, visible};
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::Value;

use super::client::VehicleClient;
use crate::args::{LogsArgs, StreamArgs};
use crate::render::{Paint, time_of_day};
use crate::stdout::print;

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
    let client = VehicleClient::new(&args.vehicle)?;
    let path = format!("{path}?last={}&follow={}", args.last, args.follow);
    let paint = Paint::of_stdout();
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
    let kind = field("event").or_else(|| field("kind")).unwrap_or_default();
    let lambda = field("lambda").map(|it| format!("{it}: ")).unwrap_or_default();
    let words = field("text").or_else(|| field("message")).unwrap_or_else(|| record.to_string());
    let words = format!("{lambda}{words}");
    let shown = match &*kind {
        "failed" | "quarantined" | "refused" | "loss" | "gap" | "torn" => paint.red(&words),
        "warning" | "rolled_back" => paint.yellow(&words),
        _ => words,
    };
    format!("{} {kind:<12} {shown}\n", paint.dim(&time))
}
