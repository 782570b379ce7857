//! Receives frames and their descriptors from a socket.

use std::io::IoSliceMut;
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recvmsg};
use serde::de::DeserializeOwned;

use super::LinkError;
use super::frame::{self, HEAD};

/// Largest number of descriptors with a frame of any connection.
pub(super) const DESCRIPTORS: usize = 4;

/// Number of bytes that are read at a time: memory grows as bytes arrive, not by the length in the
/// head.
const STEP: usize = 64 << 10;

/// The result of a look at a connection.
#[derive(Debug, PartialEq, Eq)]
pub enum Incoming<T> {
    /// The next message.
    Message(T),
    /// No complete message has arrived.
    Nothing,
    /// The other side has ended, or closed the connection.
    Ended,
}

/// Receives frames from one peer. A call that finds half a frame keeps it for the next call.
///
/// It never reads beyond the frame in progress. A descriptor arrives with the first of the bytes
/// that it was sent with, so each descriptor belongs to the frame in progress.
#[derive(Debug)]
pub(crate) struct FrameReceiver {
    peer: &'static str,
    /// Largest number of descriptors with a frame; further ones are closed.
    descriptors_max: usize,
    bytes: Vec<u8>,
    descriptors: Vec<OwnedFd>,
}

#[derive(Debug)]
pub(crate) struct ReceivedFrame {
    pub(crate) tag: u8,
    pub(crate) payload: Vec<u8>,
    pub(crate) descriptors: Vec<OwnedFd>,
}

impl FrameReceiver {
    pub(crate) fn new(peer: &'static str, descriptors_max: usize) -> FrameReceiver {
        let (bytes, descriptors) = (Vec::new(), Vec::new());
        FrameReceiver { peer, descriptors_max, bytes, descriptors }
    }

    /// Waits for the next frame. `None` when the other side has ended.
    pub(crate) fn wait(&mut self, socket: impl AsFd) -> Result<Option<ReceivedFrame>, LinkError> {
        loop {
            match self.receive(&socket, RecvFlags::empty())? {
                Incoming::Message(frame) => return Ok(Some(frame)),
                // The socket has a timeout, which this call ignores.
                Incoming::Nothing => {}
                Incoming::Ended => return Ok(None),
            }
        }
    }

    /// Returns the next frame as a message, if it is complete.
    pub(crate) fn poll<T>(
        &mut self,
        socket: impl AsFd,
        message: impl FnOnce(ReceivedFrame) -> Result<T, LinkError>,
    ) -> Result<Incoming<T>, LinkError> {
        Ok(match self.receive(&socket, RecvFlags::DONTWAIT)? {
            Incoming::Message(frame) => Incoming::Message(message(frame)?),
            Incoming::Nothing => Incoming::Nothing,
            Incoming::Ended => Incoming::Ended,
        })
    }

    /// Reads until a frame is complete, or until the call would wait.
    fn receive(
        &mut self,
        socket: &impl AsFd,
        flags: RecvFlags,
    ) -> Result<Incoming<ReceivedFrame>, LinkError> {
        loop {
            let missing = match self.bytes.first_chunk::<HEAD>() {
                None => HEAD - self.bytes.len(),
                Some(head) => {
                    let (tag, len) = frame::head(*head, self.peer)?;
                    let missing = HEAD + len - self.bytes.len();
                    if missing == 0 {
                        let payload = self.bytes.split_off(HEAD);
                        self.bytes = Vec::new();
                        let descriptors = std::mem::take(&mut self.descriptors);
                        return Ok(Incoming::Message(ReceivedFrame { tag, payload, descriptors }));
                    }
                    missing
                }
            };
            match self.read(socket, missing.min(STEP), flags) {
                Ok(0) if self.bytes.is_empty() => return Ok(Incoming::Ended),
                Ok(0) => return Err(LinkError::Gone { peer: self.peer }),
                Ok(_) | Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Ok(Incoming::Nothing),
                Err(error) => return Err(LinkError::of(self.peer, error)),
            }
        }
    }

    /// Reads at most `len` bytes, and the descriptors that come with them.
    fn read(&mut self, socket: &impl AsFd, len: usize, flags: RecvFlags) -> Result<usize, Errno> {
        let start = self.bytes.len();
        self.bytes.resize(start + len, 0);
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(DESCRIPTORS))];
        let mut ancillary = RecvAncillaryBuffer::new(&mut space);
        let mut slices = [IoSliceMut::new(&mut self.bytes[start..])];
        let flags = flags | RecvFlags::CMSG_CLOEXEC;
        let read = recvmsg(socket, &mut slices, &mut ancillary, flags);
        self.bytes.truncate(start + read.as_ref().map_or(0, |read| read.bytes));
        for message in ancillary.drain() {
            if let RecvAncillaryMessage::ScmRights(descriptors) = message {
                let room = self.descriptors_max.saturating_sub(self.descriptors.len());
                self.descriptors.extend(descriptors.take(room));
            }
        }
        Ok(read?.bytes)
    }
}

impl ReceivedFrame {
    pub(crate) fn json<T: DeserializeOwned>(&self, peer: &'static str) -> Result<T, LinkError> {
        serde_json::from_slice(&self.payload).map_err(|error| LinkError::Malformed {
            peer,
            frame: frame::name(self.tag),
            reason: error.to_string(),
        })
    }

    /// Takes the one descriptor of the frame.
    pub(crate) fn descriptor(&mut self) -> Result<OwnedFd, LinkError> {
        self.descriptors.pop().ok_or(LinkError::NoDescriptor { frame: frame::name(self.tag) })
    }
}
