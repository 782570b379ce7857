//! Publishes decisions with a trigger or a fault, on request, for other recorders and dashboards.
//!
//! `std_msgs/msg/String`, a type that every ROS 2 has; its text is a line of `decisions.jsonl`,
//! with the lambda's name before it: `{"lambda": "hello", "decision": {...}}`.

use gleaner_lambda::Decision;
use serde::Serialize;

use super::topic_publisher::TopicPublisher;

pub(super) struct Announcer {
    pub(super) publisher: TopicPublisher,
    lambda: String,
}

#[derive(Serialize)]
struct Announced<'a> {
    lambda: &'a str,
    decision: &'a Decision,
}

impl Announcer {
    pub(super) fn new(publisher: TopicPublisher, lambda: &str) -> Self {
        Self { publisher, lambda: lambda.to_owned() }
    }

    /// Publishes a decision, if it has a trigger or a fault.
    pub(super) fn decision(&mut self, decision: &Decision) {
        if decision.triggers.is_empty() && decision.fault.is_none() {
            return;
        }
        let announced = Announced { lambda: &self.lambda, decision };
        let text =
            serde_json::to_string(&announced).expect("a decision has text keys and finite numbers");
        self.publisher.publish(|message| message.string(&text));
    }
}
