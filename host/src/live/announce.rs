//! On request, decisions with a trigger or a fault are published, for recorders and dashboards of others.
//!
//! `std_msgs/msg/String`, a type that every ROS 2 has; its text is a line of `decisions.jsonl`, with the lambda's name before it:
//! `{"lambda": "hello", "decision": {...}}`.

use gleaner_protocol::{Decision, Failure};
use gleaner_transport::dds::{Dds, Writer};
use gleaner_transport::message::CdrWriter;
use serde::Serialize;

use crate::network::NetworkError;

const TYPE: &str = "std_msgs/msg/String";
/// Decisions that are kept for a reader that is slow to take them.
const DEPTH: usize = 256;

pub(super) struct Announcer {
    writer: Writer,
    lambda: String,
    unsent: u64,
    message: CdrWriter,
}

#[derive(Serialize)]
struct Announced<'a> {
    lambda: &'a str,
    decision: &'a Decision,
}

impl Announcer {
    /// Publishes decisions of `lambda` on `topic`.
    pub(super) fn open(dds: &Dds, topic: &str, lambda: &str) -> Result<Self, Failure> {
        let writer = dds.writer(topic, TYPE, DEPTH).map_err(NetworkError::failure)?;
        Ok(Self { writer, lambda: lambda.to_owned(), unsent: 0, message: CdrWriter::new() })
    }

    /// Publishes a decision, if it is one to tell. Those that cannot be sent are counted, and said now and then: they are in the files.
    pub(super) fn decision(&mut self, decision: &Decision) {
        if decision.triggers.is_empty() && decision.fault.is_none() {
            return;
        }
        let Ok(text) = serde_json::to_string(&Announced { lambda: &self.lambda, decision }) else { return };
        self.message.clear();
        self.message.string(&text);
        if let Err(error) = self.writer.write(self.message.bytes()) {
            if self.unsent.is_power_of_two() || self.unsent == 0 {
                tracing::warn!(%error, unsent = self.unsent + 1, "a decision was not announced");
            }
            self.unsent += 1;
        }
    }
}
