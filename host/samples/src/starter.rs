//! The socket over which the starter passes connections to processes that it has started again.

use std::collections::VecDeque;
use std::os::fd::OwnedFd;

use gleaner_protocol::link::{Incoming, LinkError};
use gleaner_protocol::{Handover, HandoverReceiver};

/// The socket, and the connections that were received and not taken yet.
pub(crate) struct StarterSocket {
    receiver: HandoverReceiver,
    /// Connections to ingresses, the oldest first: each may have left samples.
    pub(crate) ingresses: VecDeque<OwnedFd>,
    /// The connection to the newest recorder.
    pub(crate) recorder: Option<OwnedFd>,
    /// Set when the starter has ended, or closed the socket.
    pub(crate) has_ended: bool,
}

impl StarterSocket {
    pub(crate) fn new(socket: OwnedFd) -> Self {
        Self {
            receiver: HandoverReceiver::new(socket),
            ingresses: VecDeque::new(),
            recorder: None,
            has_ended: false,
        }
    }

    /// Receives what has arrived. Never waits.
    pub(crate) fn receive(&mut self) -> Result<(), LinkError> {
        while !self.has_ended {
            match self.receiver.poll() {
                Ok(Incoming::Message(Handover { ingress, recorder, .. })) => {
                    self.ingresses.extend(ingress);
                    self.recorder = recorder.or(self.recorder.take());
                }
                Ok(Incoming::Nothing) => return Ok(()),
                Ok(Incoming::Ended) | Err(LinkError::Gone { .. }) => self.has_ended = true,
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}
