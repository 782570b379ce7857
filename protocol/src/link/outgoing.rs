//! Sends frames and their descriptors over a socket.

use std::collections::VecDeque;
use std::io::IoSlice;
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, send, sendmsg};
use serde::Serialize;

use super::incoming::DESCRIPTORS;
use super::{LinkError, STARTER, frame};

/// Sends a frame and its descriptors, and waits until the other side has room for all of it. A peer
/// that has ended is an error, not a signal. If the socket has a timeout, the wait is as long.
pub(crate) fn send_frame(
    socket: &impl AsFd,
    mut bytes: &[u8],
    mut descriptors: &[BorrowedFd<'_>],
    peer: &'static str,
) -> Result<(), LinkError> {
    while !bytes.is_empty() {
        match send_some(socket, bytes, descriptors, SendFlags::empty()) {
            Ok(sent) => {
                bytes = &bytes[sent..];
                descriptors = &[];
            }
            Err(Errno::INTR) => {}
            Err(Errno::AGAIN) => return Err(LinkError::Full { peer }),
            Err(error) => return Err(LinkError::of(peer, error)),
        }
    }
    Ok(())
}

/// Sends a message of the starter as JSON, as [`send_frame`] does, unless it is too long.
pub(crate) fn send_json(
    socket: &impl AsFd,
    tag: u8,
    message: &impl Serialize,
    descriptors: &[BorrowedFd<'_>],
    peer: &'static str,
) -> Result<(), LinkError> {
    send_frame(socket, &frame::encode_json(tag, message, STARTER, peer)?, descriptors, peer)
}

/// Sends a frame and its descriptors as a whole, if the other side has room for it. Never waits.
pub(crate) fn try_send_frame(
    socket: &impl AsFd,
    bytes: &[u8],
    descriptors: &[BorrowedFd<'_>],
    peer: &'static str,
) -> Result<(), LinkError> {
    loop {
        match send_some(socket, bytes, descriptors, SendFlags::DONTWAIT) {
            Ok(sent) if sent == bytes.len() => return Ok(()),
            Ok(_) | Err(Errno::AGAIN) => return Err(LinkError::Full { peer }),
            Err(Errno::INTR) => {}
            Err(error) => return Err(LinkError::of(peer, error)),
        }
    }
}

/// Sends the first of `bytes`. Descriptors go with the first byte, so that they arrive before the
/// frame is complete.
fn send_some(
    socket: &impl AsFd,
    bytes: &[u8],
    descriptors: &[BorrowedFd<'_>],
    flags: SendFlags,
) -> Result<usize, Errno> {
    let flags = flags | SendFlags::NOSIGNAL;
    if descriptors.is_empty() {
        // A lambda's process must not call `sendmsg`, which can also send files.
        return send(socket, bytes, flags);
    }
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(DESCRIPTORS))];
    let mut ancillary = SendAncillaryBuffer::new(&mut space);
    if !ancillary.push(SendAncillaryMessage::ScmRights(descriptors)) {
        return Err(Errno::INVAL);
    }
    sendmsg(socket, &[IoSlice::new(bytes)], &mut ancillary, flags)
}

/// Frames that wait until the other side reads.
#[derive(Debug, Default)]
pub(crate) struct FrameQueue {
    frames: VecDeque<OutgoingFrame>,
    /// Number of bytes of all frames.
    bytes: usize,
    /// Number of bytes of the first frame that are sent.
    sent: usize,
    /// Number of bytes that were sent so far.
    total: u64,
}

#[derive(Debug)]
struct OutgoingFrame {
    bytes: Vec<u8>,
    descriptor: Option<OwnedFd>,
}

impl FrameQueue {
    pub(crate) fn push(&mut self, bytes: Vec<u8>, descriptor: Option<OwnedFd>) {
        self.bytes += bytes.len();
        self.frames.push_back(OutgoingFrame { bytes, descriptor });
    }

    /// Sends what the other side has room for. Never waits.
    pub(crate) fn flush(
        &mut self,
        socket: &impl AsFd,
        peer: &'static str,
    ) -> Result<(), LinkError> {
        while let Some(first) = self.frames.front_mut() {
            let descriptors: Vec<_> = first.descriptor.iter().map(AsFd::as_fd).collect();
            match send_some(socket, &first.bytes[self.sent..], &descriptors, SendFlags::DONTWAIT) {
                Ok(sent) => {
                    first.descriptor = None;
                    self.sent += sent;
                    self.total += sent as u64;
                }
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Ok(()),
                Err(error) => return Err(LinkError::of(peer, error)),
            }
            if let Some(frame) = self.frames.pop_front_if(|frame| frame.bytes.len() <= self.sent) {
                self.bytes -= frame.bytes.len();
                self.sent = 0;
            }
        }
        Ok(())
    }

    /// Returns true if a frame is sent in part: nothing else may be sent before its rest.
    pub(crate) fn is_begun(&self) -> bool {
        self.sent > 0
    }

    /// Returns the bytes that are not sent, without descriptors, and drops the frames.
    pub(crate) fn take_rest(&mut self) -> Vec<u8> {
        let mut rest = Vec::new();
        for frame in std::mem::take(&mut self.frames) {
            rest.extend_from_slice(&frame.bytes[std::mem::take(&mut self.sent)..]);
        }
        self.bytes = 0;
        rest
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    pub(crate) fn total(&self) -> u64 {
        self.total
    }

    /// Returns the number of bytes of frames that are not sent completely.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes
    }
}
