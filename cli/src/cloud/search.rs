//! `gleaner search`: records of the vehicles of a cloud with some text.

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::records::FoundRecords;

use super::client;
use super::list::{since, with_query};
use crate::args::SearchArgs;
use crate::output::{end_with_reader, print, show};
use crate::render::Paint;
use crate::vehicle::record_text;

/// Maximum number of records in a part.
const PART: usize = 500;
/// Maximum number of parts without a record, one after the other: a cloud that goes on for ever
/// must not keep the command busy. Each has some 32 MiB of records.
const EMPTY_MAX: usize = 100_000;

pub(super) fn search(args: &SearchArgs) -> Result<Exit, Failure> {
    let (client, paint) = (client()?, Paint::of_stdout());
    end_with_reader();
    let values = [
        ("text", Some(args.text.clone()).filter(|text| !text.is_empty())),
        ("vehicle", args.vehicle.as_ref().map(ToString::to_string)),
        ("label", args.label.clone()),
        ("lambda", args.lambda.clone()),
        ("kind", args.kind.clone()),
        ("level", args.level.clone()),
        ("from_ns", args.since.map(since)),
    ];
    let values: Vec<_> = values.into_iter().filter_map(|(key, it)| Some((key, it?))).collect();
    let (mut shown, mut empty, mut after) = (0, 0, None);
    while shown < args.last {
        let limit = PART.min(args.last - shown);
        let position = after.take().map(|after| ("after", after));
        let query = values.iter().cloned().chain([("limit", limit.to_string())]).chain(position);
        let found: FoundRecords = client.get(&with_query("/v1/records", query))?;
        empty = if found.items.is_empty() { empty + 1 } else { 0 };
        for it in found.items.iter().take(limit) {
            let (vehicle, stream) = (visible(&it.vehicle), visible(&it.line.stream));
            show(args.json, it, |it| {
                format!("{vehicle} {stream} {}", record_text(&it.line, paint))
            })?;
        }
        shown += found.items.len();
        after = found.next;
        if after.is_none() {
            break;
        }
        if empty >= EMPTY_MAX {
            let message =
                format!("the last {EMPTY_MAX} parts of records had none, and more follow");
            return Err(Failure::new(Exit::Internal, message)
                .with_help("search fewer records: `--vehicle NAME` or `--since DURATION`"));
        }
    }
    if shown == 0 && !args.json {
        print("no record was found\n")?;
    }
    Ok(Exit::Ok)
}
