//! A topic that a lambda's process writes on request. Nothing waits for it: what cannot be sent is counted, and said now and then.

use gleaner_base::Failure;
use gleaner_dds::{Dds, Writer};
use gleaner_messages::CdrWriter;

use crate::network::NetworkError;

pub(super) struct Speaker {
    topic: String,
    writer: Writer,
    unsent: u64,
    message: CdrWriter,
}

impl Speaker {
    /// Writes `topic`; its `depth` newest messages are kept for a reader that is slow to take them.
    pub(super) fn open(dds: &Dds, topic: &str, type_name: &str, depth: usize) -> Result<Self, Failure> {
        let writer = dds.writer(topic, type_name, depth).map_err(NetworkError::failure)?;
        Ok(Self { topic: topic.to_owned(), writer, unsent: 0, message: CdrWriter::new() })
    }

    /// Messages that were not sent.
    pub(super) fn unsent(&self) -> u64 {
        self.unsent
    }

    /// Sends the message that `fill` writes.
    pub(super) fn say(&mut self, fill: impl FnOnce(&mut CdrWriter) -> &mut CdrWriter) {
        self.message.clear();
        fill(&mut self.message);
        if let Err(error) = self.writer.write(self.message.bytes()) {
            self.unsent += 1;
            if self.unsent.is_power_of_two() {
                tracing::warn!(topic = %self.topic, unsent = self.unsent, %error, "a message was not sent");
            }
        }
    }
}
