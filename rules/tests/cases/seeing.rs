//! Cases of rings, limits per call, paths, names and units.

use std::collections::BTreeMap;

use gleaner_rules::clamps::{self, Length, PerCall, WrongField};
use gleaner_rules::path::{PathSegment, segments};
use gleaner_rules::ring::{Counts, Ring};
use gleaner_rules::{names, units};
use serde_json::{Value, json};

use crate::{ns, refused, replay, text, whole};

#[test]
fn rings() {
    replay("ring", include_str!("../../cases/ring.json"), |given| {
        let mut ring =
            Ring::new(whole(&given["depth"]), whole(&given["hold"]), whole(&given["max_size"]));
        let mut held = BTreeMap::new();
        Box::new(move |call, given| match call {
            "push" => {
                // The value of a sample is its time.
                let at_ns = ring.counts().received as i64;
                json!(ring.push(at_ns, whole(&given[0])))
            }
            "hold" => {
                let position = given[0].as_u64().unwrap();
                json!(ring.get(position).map(|cell| held.insert(position, cell)).is_some())
            }
            "let go" => {
                held.remove(&given[0].as_u64().unwrap());
                Value::Null
            }
            "shows" => ring
                .newest_while(whole(&given[0]), |_| true)
                .iter()
                .map(|cell| json!(cell.position))
                .collect(),
            "since" => {
                let since = ns(&given[0]);
                ring.newest_while(99, |at_ns| *at_ns > since)
                    .iter()
                    .map(|cell| json!(cell.position))
                    .collect()
            }
            "counts" => {
                let Counts { received, overwritten, no_slot, too_big } = ring.counts();
                json!([received, overwritten, no_slot, too_big])
            }
            other => panic!("{other}"),
        })
    });
}

#[test]
fn clamps() {
    replay("clamps", include_str!("../../cases/clamps.json"), |given| {
        let per_call = PerCall { bytes: whole(&given["bytes"]), items: whole(&given["items"]) };
        Box::new(move |call, given| match call {
            "samples" => json!(per_call.samples().min(whole(&given[0]))),
            "piece" => {
                let place = per_call.piece(
                    whole(&given[0]),
                    given[1].as_u64().unwrap(),
                    whole(&given[2]) as u32,
                );
                json!([place.start, place.len()])
            }
            "value" => {
                let len = whole(&given[2]);
                let length = match text(&given[1]) {
                    "one" => Length::One,
                    "text" => Length::Text(len),
                    "bytes" => Length::Bytes(len),
                    "numbers" => Length::Numbers(len),
                    _ => Length::Texts(len),
                };
                refused(per_call.value(text(&given[0]), length))
            }
            "path" => refused(clamps::path(text(&given[0]))),
            "elsewhere" => {
                json!(
                    WrongField::elsewhere(text(&given[0]), text(&given[1]), text(&given[2]))
                        .to_string()
                )
            }
            "no number" => {
                json!(WrongField::no_number(text(&given[0]), text(&given[1])).to_string())
            }
            other => panic!("{other}"),
        })
    });
}

#[test]
fn paths() {
    replay("paths", include_str!("../../cases/paths.json"), |_| {
        Box::new(|call, given| match call {
            "segments" => {
                let plain = |segment: &PathSegment<'_>| match segment {
                    PathSegment::Name(name) => json!(name),
                    PathSegment::Index(index) => json!(index),
                };
                segments(text(&given[0])).unwrap().iter().map(plain).collect()
            }
            _ => refused(segments(text(&given[0]))),
        })
    });
}

#[test]
fn names() {
    replay("names", include_str!("../../cases/names.json"), |_| {
        Box::new(|call, given| {
            let is_valid = match call {
                "lambda" => names::is_lambda,
                "item" => names::is_item,
                "topic" => names::is_topic,
                _ => names::is_type,
            };
            json!(is_valid(text(&given[0])))
        })
    });
}

#[test]
fn sizes_and_durations() {
    replay("units", include_str!("../../cases/units.json"), |_| {
        Box::new(|call, given| match call {
            "size" => json!(units::size(text(&given[0]))),
            _ => json!(units::duration(text(&given[0]))),
        })
    });
}
