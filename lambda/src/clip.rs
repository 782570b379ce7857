//! A recorded clip, as `clips.jsonl` lists it.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::manifest::LambdaKind;
use crate::{Trigger, TriggerKind};

/// A written clip: one line of `clips.jsonl`.
///
/// The order of the fields is the order of the keys in the file. An unknown number is `null`, never
/// 0.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Clip {
    /// The file, relative to the folder that holds `clips.jsonl`, for example
    /// `clips/hello-20180802T083451.136Z.mcap`.
    pub file: PathBuf,
    /// A small JPEG of the event, relative to the same folder; `None` if the clip has no image.
    pub thumbnail: Option<PathBuf>,
    /// Length of the file, in bytes.
    pub bytes: u64,
    /// Start of its earliest window, in ns since the epoch of the drive.
    pub from_ns: i64,
    /// End of its latest window, inclusive.
    pub to_ns: i64,
    /// Stamp of its first message; `None` if it has none.
    pub first_ns: Option<i64>,
    /// Stamp of its last message; `None` if it has none.
    pub last_ns: Option<i64>,
    /// The lambdas whose windows it contains.
    pub lambdas: Vec<ClipLambda>,
    /// Number of triggers of these lambdas, and of commands in their name, within it.
    pub triggers: u64,
    /// The first [`MOMENTS_MAX`](Self::MOMENTS_MAX) of the triggers; the MCAP file has more of
    /// them.
    pub moments: Vec<Moment>,
    /// The recorded topics, with the data that is missing.
    pub topics: Vec<ClipTopic>,
    /// The reasons why it holds less than its windows cover; empty if it is complete.
    pub incomplete: Vec<String>,
    /// Set if the recorder died while it wrote the clip, which was recovered later.
    pub recovered: Option<Recovered>,
}

impl Clip {
    /// Maximum number of moments in one line, so that a lambda that triggers in every wake leaves a
    /// readable line.
    pub const MOMENTS_MAX: usize = 100;
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClipLambda {
    pub name: String,
    pub version: String,
    pub kind: LambdaKind,
    /// SHA-256 of the digests of its files, in hexadecimal digits.
    pub digest: String,
    pub windows: u64,
}

/// A trigger or a command, as a clip lists it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Moment {
    /// The lambda that triggered, or whose `[record]` a command used.
    pub lambda: String,
    pub kind: TriggerKind,
    /// The lambda's name for the event.
    pub label: String,
    /// Confidence or strength; always finite.
    pub score: Option<f64>,
    /// Further values from the lambda; `None` if they take more than [`Moment::ATTRIBUTE_BYTES`]:
    /// then only the journal has them.
    pub attributes: Option<Map<String, Value>>,
    /// Stamp of the wake, in ns since the epoch of the drive.
    pub at_ns: i64,
    /// Origin of a moment that the lambda did not cause; no journal has such a moment.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
}

impl Moment {
    /// Maximum length of attributes as JSON: thousands of moments may wait for their clip.
    pub const ATTRIBUTE_BYTES: usize = 2048;

    /// Creates the moment of `trigger`, by the lambda of this name, in a wake at `at_ns`.
    pub fn of(lambda: &str, trigger: &Trigger, at_ns: i64) -> Moment {
        Moment {
            lambda: lambda.to_owned(),
            kind: trigger.kind,
            label: trigger.label.clone(),
            score: trigger.score,
            attributes: fits(&trigger.attributes).then(|| trigger.attributes.clone()),
            at_ns,
            source: None,
        }
    }
}

impl Moment {
    /// Returns the first key whose value differs in `other`, with both values as JSON. Values are
    /// compared as text, so that `-0.0` differs from `0.0`.
    pub fn differs_from(&self, other: &Moment) -> Option<(String, [String; 2])> {
        let values = [self, other]
            .map(|moment| serde_json::to_value(moment).expect("a moment is plain data"));
        let text = |side: usize, key: &str| {
            values[side].get(key).map_or_else(|| "none".to_owned(), Value::to_string)
        };
        let keys = values.iter().filter_map(Value::as_object).flat_map(Map::keys);
        let mut both = keys.map(|key| (key, [text(0, key), text(1, key)]));
        both.find(|(_, [one, other])| one != other).map(|(key, both)| (key.clone(), both))
    }
}

fn fits(attributes: &Map<String, Value>) -> bool {
    serde_json::to_string(attributes).is_ok_and(|text| text.len() <= Moment::ATTRIBUTE_BYTES)
}

/// A topic of a clip. `None` means unknown, for example after the recorder died.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClipTopic {
    pub topic: String,
    /// Message type of the topic; `None` if it was requested and never appeared.
    pub type_name: Option<String>,
    pub messages: u64,
    /// Number of its messages that reached the recorder within the windows of the clip.
    pub received: Option<u64>,
    /// Number of messages lost before they reached the recorder.
    pub lost: Option<u64>,
    /// Number of messages that left the full preroll before the clip was opened.
    pub overwritten: Option<u64>,
    /// Number of messages larger than the preroll.
    pub too_big: Option<u64>,
}

/// The recovery of a clip after the recorder died.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Recovered {
    /// Bytes after the last whole chunk, which were discarded.
    pub lost_bytes: u64,
    /// A description of the event and of the missing data.
    pub note: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clip() -> Clip {
        let trigger = Trigger {
            kind: TriggerKind::Event,
            label: "hard-brake".to_owned(),
            score: Some(0.5),
            attributes: serde_json::Map::new(),
        };
        Clip {
            file: "clips/hello-20180802T083451.136Z.mcap".into(),
            thumbnail: None,
            bytes: 4096,
            from_ns: 1_000,
            to_ns: 11_000,
            first_ns: Some(1_001),
            last_ns: None,
            lambdas: vec![ClipLambda {
                name: "hello".to_owned(),
                version: "0.1.0".to_owned(),
                kind: LambdaKind::Wasm,
                digest: "00ff".to_owned(),
                windows: 2,
            }],
            triggers: 3,
            moments: vec![Moment::of("hello", &trigger, 6_000)],
            topics: vec![ClipTopic {
                topic: "/imu/data".to_owned(),
                type_name: Some("sensor_msgs/msg/Imu".to_owned()),
                messages: 7,
                received: Some(8),
                lost: None,
                overwritten: Some(1),
                too_big: Some(0),
            }],
            incomplete: vec!["the drive ended 2.1 s before the window did".to_owned()],
            recovered: Some(Recovered { lost_bytes: 5, note: "the recorder died".to_owned() }),
        }
    }

    #[test]
    fn a_clip_is_one_line_with_the_keys_in_the_order_of_its_fields() {
        let line = serde_json::to_string(&clip()).unwrap();
        assert_eq!(
            line,
            concat!(
                r#"{"file":"clips/hello-20180802T083451.136Z.mcap","thumbnail":null,"#,
                r#""bytes":4096,"from_ns":1000,"#,
                r#""to_ns":11000,"first_ns":1001,"last_ns":null,"lambdas":[{"name":"hello","#,
                r#""version":"0.1.0","#,
                r#""kind":"wasm","digest":"00ff","windows":2}],"triggers":3,"#,
                r#""moments":[{"lambda":"hello","#,
                r#""kind":"event","label":"hard-brake","score":0.5,"attributes":{},"#,
                r#""at_ns":6000}],"topics":[{"topic":"/imu/data","#,
                r#""type_name":"sensor_msgs/msg/Imu","messages":7,"received":8,"lost":null,"#,
                r#""overwritten":1,"#,
                r#""too_big":0}],"incomplete":["the drive ended 2.1 s before the window did"],"#,
                r#""recovered":{"lost_bytes":5,"note":"the recorder died"}}"#
            )
        );
        assert_eq!(serde_json::from_str::<Clip>(&line).unwrap(), clip());
    }

    #[test]
    fn a_moment_that_no_lambda_caused_has_its_source() {
        let trigger = Trigger {
            kind: TriggerKind::Stop,
            label: "x".to_owned(),
            score: None,
            attributes: serde_json::Map::new(),
        };
        let moment =
            Moment { source: Some("command on /c".to_owned()), ..Moment::of("l", &trigger, 1) };
        let line = serde_json::to_string(&moment).unwrap();
        assert!(line.ends_with(r#""at_ns":1,"source":"command on /c"}"#), "{line}");
        assert_eq!(serde_json::from_str::<Moment>(&line).unwrap(), moment);
    }

    #[test]
    fn moments_differ_by_their_first_key() {
        let moment = &clip().moments[0];
        assert_eq!(moment.differs_from(moment), None);
        let zero = Moment { score: Some(0.0), ..moment.clone() };
        let other = Moment { score: Some(-0.0), at_ns: 7, ..moment.clone() };
        assert_eq!(
            zero.differs_from(&other),
            Some(("score".to_owned(), ["0.0", "-0.0"].map(str::to_owned)))
        );
        let command = Moment { source: Some("command on /c".to_owned()), ..moment.clone() };
        assert_eq!(
            moment.differs_from(&command).map(|(key, [one, _])| (key, one)),
            Some(("source".to_owned(), "none".to_owned()))
        );
    }

    #[test]
    fn large_attributes_are_left_to_the_journal() {
        let trigger = |bytes: usize| Trigger {
            kind: TriggerKind::Event,
            label: "x".to_owned(),
            score: None,
            attributes: serde_json::Map::from_iter([("text".to_owned(), "y".repeat(bytes).into())]),
        };
        assert_eq!(Moment::of("l", &trigger(100), 1).attributes, Some(trigger(100).attributes));
        assert_eq!(Moment::of("l", &trigger(Moment::ATTRIBUTE_BYTES), 1).attributes, None);
    }

    #[test]
    fn an_unknown_number_is_null() {
        let mut unknown = clip();
        let topic = &mut unknown.topics[0];
        (topic.received, topic.lost, topic.overwritten, topic.too_big) = (None, None, None, None);
        let line = serde_json::to_string(&unknown).unwrap();
        assert!(
            line.contains(r#""received":null,"lost":null,"overwritten":null,"too_big":null"#),
            "{line}"
        );
        assert_eq!(serde_json::from_str::<Clip>(&line).unwrap(), unknown);
    }
}
