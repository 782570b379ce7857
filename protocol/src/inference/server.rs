//! The end of `gleaner-inference` of the connection to a lambda's process.

use std::io::{IoSlice, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{
    RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, ReturnFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, recvmsg, sendmsg,
};

use super::{MESSAGE_MAX, ModelFault, ModelFaultKind, ModelReply, ModelRequest, ModelResult};
use crate::link::{Incoming, LinkError};

const LAMBDA: &str = "a lambda";

/// The connection to a lambda's process. Its descriptor is readable when [`poll`](Self::poll) has
/// something to read. No call waits.
#[derive(Debug)]
pub struct ModelSocket {
    socket: OwnedFd,
}

impl ModelSocket {
    /// Uses this end of the connection.
    pub fn new(socket: OwnedFd) -> ModelSocket {
        ModelSocket { socket }
    }

    /// Returns the next call, if there is one.
    ///
    /// # Errors
    ///
    /// [`LinkError::Malformed`] and [`LinkError::TooLong`] for a message that is no call, from a
    /// process that is not to be served any more.
    pub fn poll(&self) -> Result<Incoming<ModelRequest>, LinkError> {
        match receive(&self.socket, LAMBDA) {
            Ok(None) => Ok(Incoming::Nothing),
            Err(LinkError::Gone { .. }) => Ok(Incoming::Ended),
            Err(error) => Err(error),
            Ok(Some((bytes, _))) => {
                serde_json::from_slice(&bytes).map(Incoming::Message).map_err(|error| {
                    let (frame, reason) = ("call", error.to_string());
                    LinkError::Malformed { peer: LAMBDA, frame, reason }
                })
            }
        }
    }

    /// Sends a reply, with a region if it has a new one.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the process has ended, [`LinkError::Full`] if it does not read.
    pub fn reply(
        &self,
        reply: &ModelReply,
        region: Option<BorrowedFd<'_>>,
    ) -> Result<(), LinkError> {
        let failed = |source| LinkError::Socket { peer: LAMBDA, source };
        let bytes = serde_json::to_vec(reply).map_err(|error| failed(error.into()))?;
        if bytes.len() > MESSAGE_MAX {
            let (frame, bytes) = ("reply", bytes.len() as u64);
            let max = MESSAGE_MAX;
            return Err(LinkError::TooLong { peer: "gleaner-inference", frame, bytes, max });
        }
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut ancillary = SendAncillaryBuffer::new(&mut space);
        let descriptors: Vec<_> = region.into_iter().collect();
        if !descriptors.is_empty() && !ancillary.push(SendAncillaryMessage::ScmRights(&descriptors))
        {
            return Err(LinkError::of(LAMBDA, Errno::INVAL));
        }
        let flags = SendFlags::NOSIGNAL | SendFlags::DONTWAIT;
        loop {
            match sendmsg(&self.socket, &[IoSlice::new(&bytes)], &mut ancillary, flags) {
                Ok(_) => return Ok(()),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Err(LinkError::Full { peer: LAMBDA }),
                Err(error) => return Err(LinkError::of(LAMBDA, error)),
            }
        }
    }
}

impl AsFd for ModelSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// Sends a lambda's process, over the end of `gleaner-inference`, that this has ended for `reason`,
/// or without one, that it has started again. The starter calls it.
///
/// # Errors
///
/// Those of [`ModelSocket::reply`].
pub fn report_state(socket: &OwnedFd, reason: Option<&str>) -> Result<(), LinkError> {
    let copy = socket.try_clone();
    let copy = copy.map_err(|source| LinkError::Socket { peer: LAMBDA, source })?;
    let result = reason.map_or(Ok(ModelResult::Started), |reason| {
        Err(ModelFault::new(ModelFaultKind::Unavailable, reason))
    });
    ModelSocket { socket: copy }.reply(&ModelReply { id: 0, region: 0, result }, None)
}

/// A message, and the descriptors that came with it.
type Received = (Vec<u8>, Vec<OwnedFd>);

/// Receives a message from `peer`, if there is one.
pub(super) fn receive(socket: &OwnedFd, peer: &'static str) -> Result<Option<Received>, LinkError> {
    let mut bytes = vec![0; MESSAGE_MAX];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut ancillary = RecvAncillaryBuffer::new(&mut space);
    let flags = RecvFlags::CMSG_CLOEXEC | RecvFlags::DONTWAIT;
    let read = recvmsg(socket, &mut [IoSliceMut::new(&mut bytes)], &mut ancillary, flags);
    let mut descriptors = Vec::new();
    for message in ancillary.drain() {
        if let RecvAncillaryMessage::ScmRights(received) = message {
            descriptors.extend(received);
        }
    }
    match read {
        Err(Errno::AGAIN | Errno::INTR) => Ok(None),
        Err(error) => Err(LinkError::of(peer, error)),
        // No message is empty.
        Ok(read) if read.bytes == 0 => Err(LinkError::Gone { peer }),
        Ok(read) if read.flags.contains(ReturnFlags::TRUNC) => {
            let bytes = read.bytes as u64 + 1;
            Err(LinkError::TooLong { peer, frame: "message", bytes, max: MESSAGE_MAX })
        }
        Ok(read) => {
            bytes.truncate(read.bytes);
            Ok(Some((bytes, descriptors)))
        }
    }
}
