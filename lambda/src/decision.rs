//! The decision of a lambda in one wake: triggers, fault and cost.

use serde::{Deserialize, Serialize};

/// The outcome of one wake of a lambda: one line of `decisions.jsonl`.
///
/// The order of the fields is the order of the keys in the file. JSON has no infinities and no NaN,
/// and would carry `null` in their place; so the host refuses a trigger with such a score or
/// attribute, as a fault of the lambda.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// Log time of the sample or tick that woke the lambda, in ns since the epoch of the drive.
    pub at_ns: i64,
    pub cause: Cause,
    /// Name of the input that woke it; `None` for a tick.
    pub input: Option<String>,
    /// Topic of the waking sample; `None` for a tick.
    pub topic: Option<String>,
    /// GUID of the sample's writer, 32 hexadecimal digits; `None` for a tick, or if the drive does
    /// not contain it.
    pub writer: Option<String>,
    /// Sequence number of the waking sample among those of its writer.
    pub seq: Option<u64>,
    pub triggers: Vec<Trigger>,
    /// The fault that ended the wake early, if any. Triggers before it still count.
    pub fault: Option<Fault>,
    /// Fuel that the wake burnt; `None` for Python, which has none, and after [`FaultKind::Stack`],
    /// as the fuel burnt until a stack is full depends on the processor.
    pub fuel: Option<u64>,
    /// Time in the lambda, in ns. It differs from run to run, so twins are not compared by it.
    pub run_ns: u64,
    /// Run time of models for this wake, in ns. It is a part of `run_ns`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub model_ns: u64,
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// A sample on the input that `schedule.event` names.
    #[default]
    Event,
    /// The clock, by `schedule.period`.
    Tick,
}

/// An action that a lambda took.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trigger {
    pub kind: TriggerKind,
    /// The lambda's name for the event, for example `hard-brake`.
    pub label: String,
    /// Confidence or strength, as the lambda defines it; always finite.
    pub score: Option<f64>,
    /// Further values for readers of the clip, in the order in which the lambda set them.
    pub attributes: serde_json::Map<String, serde_json::Value>,
}

/// The action that a trigger requests from the recorder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TriggerKind {
    /// Open the `[record]` window around the waking sample.
    Event,
    /// Begin a clip that lasts until `stop`.
    Start,
    /// End the clip that `start` began.
    Stop,
}

impl TriggerKind {
    /// Returns the word in files: `event`, `start` or `stop`.
    pub fn as_str(self) -> &'static str {
        match self {
            TriggerKind::Event => "event",
            TriggerKind::Start => "start",
            TriggerKind::Stop => "stop",
        }
    }
}

/// The reason why a wake ended early.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fault {
    pub kind: FaultKind,
    pub message: String,
    /// The amount used, in the unit of the limit: fuel units, ns for a deadline, bytes for memory.
    pub used: Option<u64>,
    /// The limit, in the same unit.
    pub allowed: Option<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaultKind {
    Fuel,
    Deadline,
    Memory,
    Stack,
    /// WebAssembly trapped: a panic, a division by zero, an access out of bounds.
    Trap,
    /// A host function refused a call.
    HostCall,
    /// Python raised an exception, or a WebAssembly lambda returned an error.
    Exception,
    /// The process was killed, for example at the hard deadline.
    Killed,
}

/// Tolerance between the scores of twins, relative to the larger magnitude of the two.
pub const SCORE_TOLERANCE: f64 = 1e-5;

/// Compares the decisions of two twins on the same wake: describes the first difference; `None` if
/// they agree.
///
/// Twins agree when `at_ns`, `topic`, `seq`, and the kinds and labels of the triggers are equal and
/// scores are within [`SCORE_TOLERANCE`] of the larger one. Fuel, time and attributes may differ:
/// they belong to the language.
pub fn twins_differ(a: &Decision, b: &Decision) -> Option<String> {
    if a.at_ns != b.at_ns {
        return Some(format!("at_ns is {} and {}", a.at_ns, b.at_ns));
    }
    if a.topic != b.topic {
        let name = |topic: &Option<String>| {
            topic.as_ref().map_or("none".to_owned(), |topic| format!("`{topic}`"))
        };
        return Some(format!("topic is {} and {}", name(&a.topic), name(&b.topic)));
    }
    if a.seq != b.seq {
        let number = |seq: Option<u64>| seq.map_or("none".to_owned(), |seq| seq.to_string());
        return Some(format!("seq is {} and {}", number(a.seq), number(b.seq)));
    }
    if a.triggers.len() != b.triggers.len() {
        return Some(format!(
            "the number of triggers is {} and {}",
            a.triggers.len(),
            b.triggers.len()
        ));
    }
    let mut pairs = a.triggers.iter().zip(&b.triggers).enumerate();
    pairs.find_map(|(index, (a, b))| {
        triggers_differ(a, b).map(|difference| format!("trigger {}: {difference}", index + 1))
    })
}

fn triggers_differ(a: &Trigger, b: &Trigger) -> Option<String> {
    if a.kind != b.kind {
        return Some(format!("kind is {} and {}", a.kind.as_str(), b.kind.as_str()));
    }
    if a.label != b.label {
        return Some(format!("label is `{}` and `{}`", a.label, b.label));
    }
    let agree = match (a.score, b.score) {
        (Some(a), Some(b)) => a == b || (a - b).abs() <= SCORE_TOLERANCE * a.abs().max(b.abs()),
        (None, None) => true,
        _ => false,
    };
    let number = |score: Option<f64>| score.map_or("none".to_owned(), |score| score.to_string());
    (!agree).then(|| format!("score is {} and {}", number(a.score), number(b.score)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decision() -> Decision {
        Decision {
            at_ns: 1_700_000_000_000_000_000,
            cause: Cause::Event,
            input: Some("camera".to_owned()),
            topic: Some("/camera/front".to_owned()),
            writer: Some("0123456789abcdef0123456789abcdef".to_owned()),
            seq: Some(7),
            triggers: vec![Trigger {
                kind: TriggerKind::Event,
                label: "hard-brake".to_owned(),
                score: Some(0.5),
                attributes: serde_json::Map::from_iter([
                    ("mps2".to_owned(), serde_json::json!(-4.5)),
                    ("luma".to_owned(), serde_json::json!(12)),
                ]),
            }],
            fault: None,
            fuel: Some(1234),
            run_ns: 5600,
            model_ns: 0,
        }
    }

    fn changed(change: impl FnOnce(&mut Decision)) -> Option<String> {
        let mut other = decision();
        change(&mut other);
        twins_differ(&decision(), &other)
    }

    #[test]
    fn a_decision_is_one_line_with_the_keys_in_the_order_of_its_fields() {
        let line = serde_json::to_string(&decision()).unwrap();
        assert_eq!(
            line,
            concat!(
                r#"{"at_ns":1700000000000000000,"cause":"event","input":"camera","#,
                r#""topic":"/camera/front","#,
                r#""writer":"0123456789abcdef0123456789abcdef","seq":7,"#,
                r#""triggers":[{"kind":"event","#,
                r#""label":"hard-brake","score":0.5,"attributes":{"mps2":-4.5,"luma":12}}],"#,
                r#""fault":null,"fuel":1234,"run_ns":5600}"#
            )
        );
        assert_eq!(serde_json::from_str::<Decision>(&line).unwrap(), decision());
    }

    #[test]
    fn a_tick_with_a_fault_reads_back_as_it_was_written() {
        let fault = Fault {
            kind: FaultKind::HostCall,
            message: "offset 9 is beyond the frame".to_owned(),
            used: None,
            allowed: Some(8),
        };
        let tick = Decision {
            cause: Cause::Tick,
            input: None,
            topic: None,
            writer: None,
            seq: None,
            triggers: Vec::new(),
            fault: Some(fault),
            fuel: None,
            ..decision()
        };
        let line = serde_json::to_string(&tick).unwrap();
        assert!(line.contains(
            r#""cause":"tick","input":null,"topic":null,"writer":null,"seq":null,"triggers":[]"#
        ));
        assert!(line.contains(concat!(
            r#""fault":{"kind":"host_call","message":"offset 9 is beyond the frame","used":null,"#,
            r#""allowed":8}"#
        )));
        assert_eq!(serde_json::from_str::<Decision>(&line).unwrap(), tick);
    }

    #[test]
    fn twins_agree_regardless_of_fuel_time_and_attributes() {
        let difference = changed(|twin| {
            twin.fuel = None;
            twin.run_ns = 1;
            twin.writer = None;
            twin.triggers[0].attributes.clear();
        });
        assert_eq!(difference, None);
    }

    #[test]
    fn scores_of_twins_agree_within_their_tolerance() {
        assert_eq!(changed(|twin| twin.triggers[0].score = Some(0.500_004)), None);
        let difference = changed(|twin| twin.triggers[0].score = Some(0.500_006));
        assert_eq!(difference.as_deref(), Some("trigger 1: score is 0.5 and 0.500006"));
        let difference = changed(|twin| twin.triggers[0].score = None);
        assert_eq!(difference.as_deref(), Some("trigger 1: score is 0.5 and none"));
        let difference = changed(|twin| twin.triggers[0].score = Some(f64::NAN));
        assert_eq!(difference.as_deref(), Some("trigger 1: score is 0.5 and NaN"));
    }

    #[test]
    fn the_first_difference_between_twins_is_described() {
        type Change = fn(&mut Decision);
        let cases: [(Change, &str); 6] = [
            (|twin| twin.at_ns = 5, "at_ns is 1700000000000000000 and 5"),
            (|twin| twin.topic = None, "topic is `/camera/front` and none"),
            (|twin| twin.seq = Some(8), "seq is 7 and 8"),
            (|twin| twin.triggers.clear(), "the number of triggers is 1 and 0"),
            (|twin| twin.triggers[0].kind = TriggerKind::Stop, "trigger 1: kind is event and stop"),
            (
                |twin| twin.triggers[0].label = "x".to_owned(),
                "trigger 1: label is `hard-brake` and `x`",
            ),
        ];
        for (change, difference) in cases {
            assert_eq!(changed(change).as_deref(), Some(difference));
        }
    }
}
