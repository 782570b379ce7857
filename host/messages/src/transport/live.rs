//! The interface of live sources beyond [`Transport`]: health, and topics that this process
//! publishes.

use gleaner_base::{Exit, Explain};
use gleaner_protocol::ingress::{Health, JoinedParticipant};

use crate::transport::{Subscription, TopicSpec, Transport};

/// A source whose samples arrive in real time.
pub trait LiveSource: Transport + Send {
    /// Returns the state of the source. It is called once a second, and must be cheap.
    fn health(&self) -> Health;

    /// Returns the participant of a network that this source is.
    fn joined(&self) -> Option<JoinedParticipant> {
        None
    }

    /// Returns whether a subscription that was made for `spec` also receives what `wanted`, of the
    /// same topic, needs.
    fn suffices(&self, spec: &TopicSpec, wanted: &TopicSpec) -> bool {
        wanted.max_bytes <= spec.max_bytes && wanted.queue <= spec.queue
    }

    /// Ends a subscription: its sink gets no further samples, once calls in progress have returned.
    /// The numbers of other subscriptions stay.
    fn unsubscribe(&mut self, subscription: Subscription);

    /// Returns the hash (RIHS01) of the layout in which samples of a subscription are received;
    /// those of writers that announce another one are left out. `None` while no writer has
    /// announced one.
    fn layout(&self, _subscription: Subscription) -> Option<String> {
        None
    }

    /// Starts a source that waits until all of its readers are ready, as a drive does.
    fn begin(&mut self) {}

    /// Returns whether the source has delivered its last sample. A network never ends.
    fn has_ended(&self) -> bool {
        false
    }

    /// Returns whether [`topics`](Transport::topics) is complete from the start. On a network,
    /// further topics may appear.
    fn knows_all_topics(&self) -> bool {
        false
    }

    /// Opens `topic` of type `type_name` for publishing. Slow readers find the `depth` newest
    /// messages.
    ///
    /// # Errors
    ///
    /// [`PublishError`] if the topic or the type has no valid name, or if the network refuses it.
    fn publisher(
        &self,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<Box<dyn Publisher>, PublishError>;
}

/// A topic that this process publishes.
pub trait Publisher: Send {
    /// Publishes a message, little-endian CDR without its four bytes of encapsulation, without
    /// waiting for a reader.
    ///
    /// # Errors
    ///
    /// [`PublishError`] if the message was not sent, for example because readers do not keep up.
    fn publish(&self, cdr: &[u8]) -> Result<(), PublishError>;
}

/// A failure to open a topic for publishing, or to send a message.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct PublishError(pub Box<dyn std::error::Error + Send + Sync>);

impl Explain for PublishError {
    fn exit(&self) -> Exit {
        Exit::Usage
    }
}
