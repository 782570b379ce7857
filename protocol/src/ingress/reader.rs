//! The ingress's end of a reader's connection. The other end is an untrusted peer: each byte is
//! checked, no descriptor is accepted, and nothing waits for it.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::buffer::spare_capacity;
use rustix::io::Errno;
use rustix::net::{RecvFlags, recv};

use super::ReaderMessage;
use crate::link::frame::{self, HEAD, tag};
use crate::link::{FRAME_MAX, FrameQueue, Incoming, LinkError};

const INGRESS: &str = "the ingress";
const READER: &str = "the reader";

/// Longest message that a reader may publish, in bytes of CDR.
pub const PUBLISH_MAX: usize = 256 << 10;

/// Longest payload of a reader's frame: an index and a message.
pub(super) const REQUEST_MAX: usize = 4 + PUBLISH_MAX;

/// Number of bytes that may wait for a reader: definitions of a few hundred topics.
const QUEUE_BYTES: usize = 16 << 20;

/// Number of bytes that are read at a time, at least.
const STEP: usize = 64 << 10;

/// Number of reads in one call of [`ReaderLink::poll`].
const READS: usize = 4;

/// A request of a reader.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ReaderRequest {
    /// It has no definitions of a topic.
    NeedDefinitions {
        /// The id of the topic.
        id: u32,
    },
    /// It does not know the layout that the writers of a topic announce.
    NeedLayout {
        /// The id of the topic.
        id: u32,
    },
    /// Publish a message.
    Publish {
        /// Index of the topic among those that the reader may publish.
        index: u32,
        /// The message, at most [`PUBLISH_MAX`] bytes.
        cdr: Vec<u8>,
    },
}

/// The ingress's end of a reader's connection. No call waits.
///
/// To wait for many readers, poll the descriptor: for reading always, for writing while
/// [`is_pending`](Self::is_pending).
#[derive(Debug)]
pub struct ReaderLink {
    socket: OwnedFd,
    queue: FrameQueue,
    received: Vec<u8>,
    /// Number of received bytes that were returned as requests.
    parsed: usize,
    /// Number of bytes that were received since [`take_received`](Self::take_received).
    uncounted: usize,
}

impl ReaderLink {
    /// Creates the link from the socket that the starter sent.
    pub fn new(socket: OwnedFd) -> ReaderLink {
        let (queue, received) = (FrameQueue::default(), Vec::new());
        ReaderLink { socket, queue, received, parsed: 0, uncounted: 0 }
    }

    /// Sends a message, with a descriptor if it is [`Welcome`](ReaderMessage::Welcome) or
    /// [`Attached`](ReaderMessage::Attached). What the reader has no room for is queued.
    /// A [`Status`](ReaderMessage::Status) is not sent while other messages wait: a newer one
    /// follows.
    ///
    /// # Errors
    ///
    /// [`LinkError::Full`] if the reader has not read its messages for long: end the connection.
    /// [`LinkError::Gone`] if it has ended. [`LinkError::TooLong`], for example for definitions of
    /// 2 MiB; then nothing is sent, and the connection stays usable.
    pub fn send(
        &mut self,
        message: &ReaderMessage,
        descriptor: Option<BorrowedFd<'_>>,
    ) -> Result<(), LinkError> {
        let failed = |source| LinkError::Socket { peer: READER, source };
        self.flush()?;
        if matches!(message, ReaderMessage::Status(_)) && self.is_pending() {
            return Ok(());
        }
        let payload = serde_json::to_vec(message).map_err(|error| failed(error.into()))?;
        if payload.len() > FRAME_MAX {
            return Err(LinkError::TooLong {
                peer: INGRESS,
                frame: frame::name(tag::READER),
                bytes: payload.len() as u64,
                max: FRAME_MAX,
            });
        }
        if self.queue.bytes() + payload.len() > QUEUE_BYTES {
            return Err(LinkError::Full { peer: READER });
        }
        let descriptor =
            descriptor.map(|fd| fd.try_clone_to_owned()).transpose().map_err(failed)?;
        self.queue.push(frame::encode(tag::READER, &payload), descriptor);
        self.flush()
    }

    /// Sends queued messages, as many as the reader has room for.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the reader has ended.
    pub fn flush(&mut self) -> Result<(), LinkError> {
        self.queue.flush(&self.socket, READER)
    }

    /// Returns true if messages wait until the reader reads.
    pub fn is_pending(&self) -> bool {
        !self.queue.is_empty()
    }

    /// Returns the number of bytes that were sent so far.
    pub fn sent_bytes(&self) -> u64 {
        self.queue.total()
    }

    /// Returns the next request if it has arrived completely. A call reads a few times only: while
    /// it returns nothing, the socket may still be readable.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the invalid frame: end the connection.
    pub fn poll(&mut self) -> Result<Incoming<ReaderRequest>, LinkError> {
        for _ in 0..READS {
            if let Some(request) = self.next_request()? {
                return Ok(Incoming::Message(request));
            }
            // Requests are removed together, as moving the rest for each would take too long.
            self.received.drain(..std::mem::take(&mut self.parsed));
            self.received.reserve(STEP);
            // Not `recvmsg`: the kernel discards descriptors of a reader.
            let room = spare_capacity(&mut self.received);
            match recv(&self.socket, room, RecvFlags::DONTWAIT) {
                // The end may also be in the middle of a frame.
                Ok((_, 0)) | Err(Errno::CONNRESET) => return Ok(Incoming::Ended),
                Ok((_, bytes)) => self.uncounted += bytes,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Ok(Incoming::Nothing),
                Err(error) => return Err(LinkError::of(READER, error)),
            }
        }
        Ok(self.next_request()?.map_or(Incoming::Nothing, Incoming::Message))
    }

    /// Returns the number of bytes that were received since the last call, complete or not.
    pub fn take_received(&mut self) -> usize {
        std::mem::take(&mut self.uncounted)
    }

    fn next_request(&mut self) -> Result<Option<ReaderRequest>, LinkError> {
        let rest = &self.received[self.parsed..];
        let Some((head, rest)) = rest.split_first_chunk::<HEAD>() else { return Ok(None) };
        let (tag, len) = frame::head(*head, READER)?;
        let malformed =
            |reason| LinkError::Malformed { peer: READER, frame: frame::name(tag), reason };
        match tag {
            tag::DEFINITIONS | tag::LAYOUT if len != 4 => {
                return Err(malformed(format!("it has {len} bytes instead of 4")));
            }
            tag::PUBLISH if !(4..=REQUEST_MAX).contains(&len) => {
                return Err(malformed(format!("it has {len} bytes instead of 4 to {REQUEST_MAX}")));
            }
            tag::DEFINITIONS | tag::LAYOUT | tag::PUBLISH => {}
            tag => return Err(LinkError::Unknown { peer: READER, tag }),
        }
        let Some((number, cdr)) = rest.get(..len).and_then(<[u8]>::split_first_chunk) else {
            return Ok(None);
        };
        let number = u32::from_le_bytes(*number);
        let request = match tag {
            tag::DEFINITIONS => ReaderRequest::NeedDefinitions { id: number },
            tag::LAYOUT => ReaderRequest::NeedLayout { id: number },
            _ => ReaderRequest::Publish { index: number, cdr: cdr.to_vec() },
        };
        self.parsed += HEAD + len;
        Ok(Some(request))
    }
}

impl AsFd for ReaderLink {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}
