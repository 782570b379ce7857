//! Publishes a topic of a lambda's process, without blocking. Messages that cannot be sent are
//! counted, and logged at increasing intervals.

use gleaner_base::Failure;
use gleaner_messages::CdrWriter;
use gleaner_transport::{LiveSource, Publisher};

pub(super) struct TopicPublisher {
    topic: String,
    publisher: Box<dyn Publisher>,
    unsent: u64,
    message: CdrWriter,
}

impl TopicPublisher {
    /// Opens `topic`; its `depth` newest messages are kept for a slow reader.
    pub(super) fn open(
        source: &dyn LiveSource,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<Self, Failure> {
        let publisher = source.publisher(topic, type_name, depth)?;
        Ok(Self { topic: topic.to_owned(), publisher, unsent: 0, message: CdrWriter::new() })
    }

    /// Number of messages that were not sent.
    pub(super) fn unsent(&self) -> u64 {
        self.unsent
    }

    /// Sends the message that `fill` writes.
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
