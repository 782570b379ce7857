//! `gleaner search`: records of the vehicles of a cloud with some text.

use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure, nanoseconds, visible};
use gleaner_fleet::records::FoundRecords;

use super::client;
use super::list::escaped;
use crate::args::SearchArgs;
use crate::render::{Paint, json_line};
use crate::stdout::{end_with_reader, print};
use crate::vehicle::record_text;

/// Maximum number of records in a part.
const PART: usize = 500;
/// Maximum number of parts without a record, one after the other: a cloud that goes on for ever
/// must not keep the command busy. Each has some 32 MiB of records.
const EMPTY_MAX: usize = 100_000;

pub(super) fn search(args: &SearchArgs) -> Result<Exit, Failure> {
    let (client, paint) = (client()?, Paint::of_stdout());
    end_with_reader();
    let since = args.since.map(|since| {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        nanoseconds(now.saturating_sub(since)).to_string()
    });
    let values = [
        ("text", Some(args.text.clone()).filter(|text| !text.is_empty())),
        ("vehicle", args.vehicle.as_ref().map(ToString::to_string)),
        ("label", args.label.clone()),
        ("lambda", args.lambda.clone()),
        ("kind", args.kind.clone()),
        ("level", args.level.clone()),
        ("from_ns", since),
    ];
    let query =
        values.into_iter().filter_map(|(key, it)| Some(format!("{key}={}&", escaped(&it?))));
    let path = format!("/v1/records?{}", query.collect::<String>());
    let (mut shown, mut empty, mut after) = (0, 0, String::new());
    while shown < args.last {
        let limit = PART.min(args.last - shown);
        let found: FoundRecords = client.get(&format!("{path}limit={limit}{after}"))?;
        empty = if found.items.is_empty() { empty + 1 } else { 0 };
        for it in found.items.iter().take(limit) {
            let (vehicle, stream) = (visible(&it.vehicle), visible(&it.line.stream));
            print(&match args.json {
                true => json_line(it),
                false => format!("{vehicle} {stream} {}", record_text(&it.line, paint)),
            })?;
        }
        shown += found.items.len();
        let Some(next) = found.next.filter(|_| empty < EMPTY_MAX) else { break };
        after = format!("&after={}", escaped(&next));
    }
    if shown == 0 && !args.json {
        print("no record was found\n")?;
    }
    Ok(Exit::Ok)
}
