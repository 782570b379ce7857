//! On request, decisions with a trigger or a fault are published, for recorders and dashboards of
//! others.
//!
//! `std_msgs/msg/String`, a type that every ROS 2 has; its text is a line of `decisions.jsonl`,
//! with the lambda's name before it: `{"lambda": "hello", "decision": {...}}`.

use gleaner_base::Failure;
use gleaner_lambda::Decision;
use gleaner_transport::LiveSource;
use serde::Serialize;

use super::speaker::Speaker;

const TYPE: &str = "std_msgs/msg/String";
/// Decisions that are kept for a reader that is slow to take them.
const DEPTH: usize = 256;

pub(super) struct Announcer {
    speaker: Speaker,
    lambda: String,
}

#[derive(Serialize)]
struct Announced<'a> {
    lambda: &'a str,
    decision: &'a Decision,
}

impl Announcer {
    /// Publishes decisions of `lambda` on `topic`.
    pub(super) fn open(
        source: &dyn LiveSource,
        topic: &str,
        lambda: &str,
    ) -> Result<Self, Failure> {
        Ok(Self { speaker: Speaker::open(source, topic, TYPE, DEPTH)?, lambda: lambda.to_owned() })
    }

    /// Decisions that were not sent.
    pub(super) fn unsent(&self) -> u64 {
        self.speaker.unsent()
    }

    /// Publishes a decision, if it is one to tell.
    pub(super) fn decision(&mut self, decision: &Decision) {
        if decision.triggers.is_empty() && decision.fault.is_none() {
            return;
        }
        let announced = Announced { lambda: &self.lambda, decision };
        let text =
            serde_json::to_string(&announced).expect("a decision has text keys and finite numbers");
        self.speaker.say(|message| message.string(&text));
    }
}
