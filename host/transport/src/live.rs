//! What every live source of samples has beside [`Transport`]: a health, and topics that this
//! process publishes.

use gleaner_base::{Exit, Explain};
use gleaner_protocol::Network;

use crate::Transport;

/// A source whose samples come while time passes.
pub trait LiveSource: Transport + Send {
    /// Returns the state of the source. Cheap enough for once a second, which is how often it is
    /// called.
    fn health(&self) -> Health;

    /// Opens `topic`, whose messages are of `type_name`, to publish on it. A reader that is slow
    /// finds the `depth` newest messages.
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

/// Why a topic cannot be published, or a message was not sent.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct PublishError(pub Box<dyn std::error::Error + Send + Sync>);

impl Explain for PublishError {
    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// The state of a live source.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Health {
    /// The network below; `None` where there is none.
    pub network: Option<Network>,
    /// Why nothing, or nothing of a topic, is handled any more; `None` while all is well.
    pub dead: Option<String>,
}
