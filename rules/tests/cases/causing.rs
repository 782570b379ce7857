//! Cases of triggers, log lines, scratch and frames.

use gleaner_rules::frames::Budget;
use gleaner_rules::log::{Rate, line};
use gleaner_rules::scratch::{Scratch, ScratchError};
use gleaner_rules::triggers::{Attribute, AttributeValue, TriggerError, TriggerKind, Triggers};
use serde_json::{Value, json};

use crate::{float, ns, refused, replay, text, whole};

fn attributes(given: &Value) -> Vec<Attribute> {
    let value = |given: &Value| match given {
        Value::Bool(value) => AttributeValue::Boolean(*value),
        Value::String(text) => AttributeValue::Text(text.clone()),
        given => given
            .as_i64()
            .map_or_else(|| AttributeValue::Real(float(given)), AttributeValue::Signed),
    };
    let pairs = given.as_array().unwrap().iter();
    pairs.map(|pair| Attribute { key: text(&pair[0]).to_owned(), value: value(&pair[1]) }).collect()
}

fn cause(
    triggers: &mut Triggers<String>,
    at_ns: i64,
    kind: TriggerKind,
    (label, score): (&Value, Option<f64>),
    attributes: Vec<Attribute>,
) -> Value {
    let label = text(label);
    let caused = triggers.cause(at_ns, kind, (label, score), attributes, |_| label.to_owned());
    caused.err().map_or(Value::Null, |error: TriggerError| {
        json!([if error.is_too_many() { "too-many" } else { "invalid" }, error.to_string()])
    })
}

#[test]
fn triggers() {
    replay("triggers", include_str!("../../cases/triggers.json"), |given| {
        let mut triggers = Triggers::new(given["per_minute"].as_u64().unwrap());
        let mut at_ns = 0;
        Box::new(move |call, given| match call {
            "begin" => {
                at_ns = ns(&given[0]);
                json!(triggers.begin())
            }
            "end" => json!(triggers.end()),
            "init" => {
                let wake = triggers.suspend();
                let answer = cause(
                    &mut triggers,
                    at_ns,
                    TriggerKind::Event,
                    (&given[0], Some(1.0)),
                    Vec::new(),
                );
                triggers.resume(wake);
                answer
            }
            "event" => {
                let asked = (&given[0], Some(float(&given[1])));
                cause(&mut triggers, at_ns, TriggerKind::Event, asked, attributes(&given[2]))
            }
            "start" => cause(
                &mut triggers,
                at_ns,
                TriggerKind::Start,
                (&given[0], None),
                attributes(&given[1]),
            ),
            "stop" => cause(&mut triggers, at_ns, TriggerKind::Stop, (&given[0], None), Vec::new()),
            "refused" => json!(triggers.refused()),
            other => panic!("{other}"),
        })
    });
}

#[test]
fn log_lines() {
    replay("log", include_str!("../../cases/log.json"), |given| {
        let mut rate =
            Rate::new(given["lines"].as_u64().unwrap(), given["bytes"].as_u64().unwrap());
        Box::new(move |call, given| match call {
            "log" => {
                let line = line(text(&given[1]));
                if rate.keeps(ns(&given[0]), line) { json!([line.len()]) } else { json!([]) }
            }
            "note" => {
                // The host's texts are constants.
                let note = text(&given[1]).to_owned().leak();
                if rate.notes(ns(&given[0]), note) { json!([note.len()]) } else { json!([]) }
            }
            "dropped" => json!(rate.dropped()),
            other => panic!("{other}"),
        })
    });
}

fn kept<T>(result: Result<T, ScratchError>, answer: impl FnOnce(T) -> Value) -> Value {
    result.map_or_else(
        |error| {
            let kind = match error {
                ScratchError::NoRoom { .. } | ScratchError::TooMany(_) => "no-room",
                ScratchError::NoSuchEntry(_) => "no-such-entry",
                ScratchError::WrongName(_) => "wrong-name",
            };
            json!([kind, error.to_string()])
        },
        answer,
    )
}

#[test]
fn scratch() {
    replay("scratch", include_str!("../../cases/scratch.json"), |given| {
        let mut scratch =
            Scratch::new(given["granted"].as_u64().unwrap(), whole(&given["call_bytes"]));
        Box::new(move |call, given| match call {
            "put" => {
                kept(scratch.put(text(&given[0]), text(&given[1]).as_bytes()), |()| Value::Null)
            }
            "append" => {
                kept(scratch.append(text(&given[0]), text(&given[1]).as_bytes()), |()| Value::Null)
            }
            "fill" => {
                json!((0..whole(&given[0])).for_each(|n| scratch.put(&n.to_string(), b"").unwrap()))
            }
            "get" => {
                let (offset, len) = (given[1].as_u64().unwrap(), given[2].as_u64().unwrap());
                kept(scratch.get(text(&given[0]), offset, len), |bytes| {
                    json!(String::from_utf8(bytes).unwrap())
                })
            }
            "remove" => kept(scratch.remove(text(&given[0])), |()| Value::Null),
            "entries" => {
                scratch.entries().iter().map(|entry| json!([entry.name, entry.bytes])).collect()
            }
            "free" => json!(scratch.free()),
            other => panic!("{other}"),
        })
    });
}

#[test]
fn frames() {
    replay("frames", include_str!("../../cases/frames.json"), |given| {
        let budget = Budget::new(whole(&given["frames"]), whole(&given["memory"]));
        let mut taken = Vec::new();
        Box::new(move |call, given| match call {
            "take" => refused(budget.take(whole(&given[0])).map(|one| taken.push(one))),
            "give back" => {
                taken.remove(whole(&given[0]));
                Value::Null
            }
            other => panic!("{other}"),
        })
    });
}
