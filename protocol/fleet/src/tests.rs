//! Messages between vehicles and clouds of other versions are read with all that they have.

use std::collections::BTreeSet;
use std::fmt::Debug;

use gleaner_protocol::vehicle_api::{StreamLine, VehicleStatus};
use prost::encoding::{WireType, encode_key};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_json::{Value, json};

use crate::clips::{ClipOrders, ClipReport};
use crate::{EnrolReply, EnrolRequest, Enrolment, Frame, RenewRequest};

/// Messages as versions have sent them, one in a line. A line is added for each new message or
/// field, and none is changed.
const RECORDED: &str = include_str!("../recorded.jsonl");

/// Returns a message as it is read, and as it is sent again.
fn read<T: DeserializeOwned + Serialize + Debug>(sent: &Value) -> (String, Value) {
    let message = T::deserialize(sent).unwrap();
    (format!("{message:?}"), serde_json::to_value(message).unwrap())
}

/// As [`read`], with the names of all fields, which a frame does not have.
fn read_frame(sent: &Value) -> (String, Value) {
    let frame = Frame::decoded(&Vec::deserialize(&sent["bytes"]).unwrap()).unwrap();
    let text = format!("{:?}", frame.body.clone().unwrap());
    let fields = sent["fields"].as_str().unwrap();
    let is_kept = fields.split(['{', ',', '}']).all(|field| text.contains(field.trim()));
    assert!(is_kept, "{text} is no longer {fields}");
    let bytes = Frame::encoded(frame.body.unwrap());
    (text, json!({ "bytes": bytes, "fields": fields }))
}

/// Returns whether a message has all of another one.
fn has(now: &Value, before: &Value) -> bool {
    match (now, before) {
        (Value::Object(now), Value::Object(before)) => {
            before.iter().all(|(key, it)| now.get(key).is_some_and(|now| has(now, it)))
        }
        (Value::Array(now), Value::Array(before)) => {
            now.len() == before.len() && now.iter().zip(before).all(|(now, it)| has(now, it))
        }
        _ => now == before,
    }
}

#[test]
fn messages_of_other_versions_are_read_and_each_message_is_recorded_with_all_its_fields() {
    let unset = [": None", ": 0,", ": 0 ", ": 0.0", ": \"\"", ": false", ": []", ": {}"];
    let mut complete = BTreeSet::new();
    for line in RECORDED.lines() {
        let (name, sent): (String, Value) = serde_json::from_str(line).unwrap();
        let (text, now) = match &*name {
            "ClipOrders" => read::<ClipOrders>(&sent),
            "ClipReport" => read::<ClipReport>(&sent),
            "EnrolReply" => read::<EnrolReply>(&sent),
            "EnrolRequest" => read::<EnrolRequest>(&sent),
            "Enrolment" => read::<Enrolment>(&sent),
            "RenewRequest" => read::<RenewRequest>(&sent),
            "StreamLine" => read::<StreamLine>(&sent),
            "VehicleStatus" => read::<VehicleStatus>(&sent),
            _ => read_frame(&sent),
        };
        assert!(has(&now, &sent), "{name}: {sent} is now {now}");
        if !unset.iter().any(|unset| text.contains(unset)) {
            complete.insert(name);
        }
    }
    let mut all = BTreeSet::from(["Enrolment", "StreamLine", "VehicleStatus"].map(str::to_owned));
    for tag in 1..1000 {
        let mut empty = Vec::new();
        encode_key(tag, WireType::LengthDelimited, &mut empty);
        empty.push(0);
        let body = Frame::decoded(&empty).unwrap().body;
        all.extend(body.map(|it| format!("{it:?}").split('(').next().unwrap().to_owned()));
    }
    // The messages that a cloud answers, by the description of that API.
    let link: Value = serde_json::from_str(include_str!("../../../docs/api/link.json")).unwrap();
    let paths = link["paths"].to_string();
    let names = paths.split("#/components/schemas/").skip(1);
    all.extend(names.map(|name| name.split('"').next().unwrap().to_owned()));
    assert_eq!(complete, all, "record what is new in protocol/fleet/recorded.jsonl");
}
