//! Publishes a topic of a lambda's process, without blocking. Messages that cannot be sent are
//! counted, and logged at increasing intervals.

use gleaner_messages::CdrWriter;
use gleaner_messages::transport::Publisher;

pub(super) struct TopicPublisher {
    topic: String,
    publisher: Box<dyn Publisher>,
    unsent: u64,
    message: CdrWriter,
}

impl TopicPublisher {
    pub(super) fn new(topic: String, publisher: Box<dyn Publisher>) -> Self {
        Self { topic, publisher, unsent: 0, message: CdrWriter::new() }
    }

    pub(super) fn replace(&mut self, publisher: Box<dyn Publisher>) {
        self.publisher = publisher;
    }

    pub(super) fn unsent(&self) -> u64 {
        self.unsent
    }

    pub(super) fn publish(&mut self, fill: impl FnOnce(&mut CdrWriter) -> &mut CdrWriter) {
        self.message.clear();
        fill(&mut self.message);
        if let Err(error) = self.publisher.publish(self.message.bytes()) {
            self.unsent += 1;
            if self.unsent.is_power_of_two() {
                let (topic, unsent) = (&self.topic, self.unsent);
                tracing::warn!(%topic, unsent, %error, "message not sent");
            }
        }
    }
}
