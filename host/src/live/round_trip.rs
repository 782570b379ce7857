//! Answers each wake on a topic, on request, so that a bench can measure the latency from a sensor
//! to a decision.
//!
//! `sensor_msgs/msg/TimeReference`, a type that every ROS 2 has: `header.stamp` is that of the
//! waking message (its receive stamp where it has none; for a tick, its due time), `time_ref` is
//! the time at which the decision was sent, `source` is `LAMBDA:WAKE:TRIGGERS` with the labels of
//! the triggers in between commas. Both stamps are of CLOCK_MONOTONIC if the message's is, as with
//! `gleaner play --stamp monotonic`.

use gleaner_lambda::Decision;
use gleaner_messages::transport::Clock;

use super::topic_publisher::TopicPublisher;
use crate::api::data::Wake;

pub(super) struct RoundTrip {
    pub(super) publisher: TopicPublisher,
    clock: Clock,
    lambda: String,
    wakes: u64,
}

impl RoundTrip {
    pub(super) fn new(publisher: TopicPublisher, clock: Clock, lambda: &str) -> Self {
        Self { publisher, clock, lambda: lambda.to_owned(), wakes: 0 }
    }

    /// Stamp of the cause of a wake, in ns.
    pub(super) fn cause(wake: &Wake, clock: Clock) -> i64 {
        match wake {
            Wake::Event(sample) => {
                let stamps = sample.stamps();
                stamps.header_ns.unwrap_or_else(|| clock.monotonic(stamps.at_ns))
            }
            Wake::Tick(tick) => clock.monotonic(tick.at_ns),
        }
    }

    pub(super) fn answer(&mut self, cause_ns: i64, decision: &Decision) {
        let labels: Vec<&str> =
            decision.triggers.iter().map(|trigger| trigger.label.as_str()).collect();
        let source = format!("{}:{}:{}", self.lambda, self.wakes, labels.join(","));
        self.wakes += 1;
        let now = self.clock.monotonic(self.clock.now());
        self.publisher
            .publish(|message| message.time(cause_ns).string("").time(now).string(&source));
    }
}
