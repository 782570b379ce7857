//! The reader's end of its connection to the ingress.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::ReaderMessage;
use super::reader::{PUBLISH_MAX, REQUEST_MAX};
use crate::link::frame::{self, HEAD, tag};
use crate::link::{FrameQueue, FrameReceiver, Incoming, LinkError};

const INGRESS: &str = "the ingress";
const READER: &str = "the reader";

/// Number of bytes that may wait for the ingress: a message that is partly sent, and another.
const QUEUE_BYTES: usize = 2 * (HEAD + REQUEST_MAX);

/// A message of the ingress.
#[derive(Debug)]
pub struct ReaderDelivery {
    /// The message.
    pub message: ReaderMessage,
    /// Its descriptor: set for [`Welcome`](ReaderMessage::Welcome) and
    /// [`Attached`](ReaderMessage::Attached), and only for these.
    pub descriptor: Option<OwnedFd>,
}

/// Receives messages of the ingress. No call waits; poll its descriptor to wait.
#[derive(Debug)]
pub struct IngressLink {
    socket: Arc<OwnedFd>,
    frames: FrameReceiver,
}

/// Sends requests to the ingress, from any thread. No call waits for the ingress, and none calls
/// `sendmsg`, which is refused to a sandboxed process. Clones share the connection.
#[derive(Debug, Clone)]
pub struct IngressRequests(Arc<RequestSender>);

#[derive(Debug)]
struct RequestSender {
    socket: Arc<OwnedFd>,
    queue: Mutex<FrameQueue>,
}

impl IngressLink {
    /// Creates both directions of the connection. It ends when the last of them is dropped.
    pub fn new(socket: OwnedFd) -> (IngressLink, IngressRequests) {
        let socket = Arc::new(socket);
        let sender = RequestSender { socket: Arc::clone(&socket), queue: Mutex::default() };
        let frames = FrameReceiver::new(INGRESS, 1);
        (IngressLink { socket, frames }, IngressRequests(Arc::new(sender)))
    }

    /// Returns the next message if it has arrived completely. Call it until it returns no message.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the invalid frame; nothing can be read after it.
    pub fn poll(&mut self) -> Result<Incoming<ReaderDelivery>, LinkError> {
        self.frames.poll(&self.socket, |mut frame| {
            if frame.tag != tag::READER {
                return Err(LinkError::Unknown { peer: INGRESS, tag: frame.tag });
            }
            let message = frame.json(INGRESS)?;
            let needs = matches!(message, ReaderMessage::Welcome | ReaderMessage::Attached(_));
            let descriptor = if needs { Some(frame.descriptor()?) } else { None };
            Ok(ReaderDelivery { message, descriptor })
        })
    }
}

impl AsFd for IngressLink {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl IngressRequests {
    /// Requests the definitions of topic `id`.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the ingress has ended, [`LinkError::Full`] if it does not read.
    pub fn need_definitions(&self, id: u32) -> Result<(), LinkError> {
        self.send(tag::DEFINITIONS, id, &[])
    }

    /// Requests the layout that the writers of topic `id` announce.
    ///
    /// # Errors
    ///
    /// As [`need_definitions`](Self::need_definitions).
    pub fn need_layout(&self, id: u32) -> Result<(), LinkError> {
        self.send(tag::LAYOUT, id, &[])
    }

    /// Publishes a message, little-endian CDR without encapsulation, in the topic that is number
    /// `index` among those that this reader may publish.
    ///
    /// # Errors
    ///
    /// [`LinkError::TooLong`] above [`PUBLISH_MAX`] bytes; otherwise those of
    /// [`need_definitions`](Self::need_definitions). The message is not sent then.
    pub fn publish(&self, index: u32, cdr: &[u8]) -> Result<(), LinkError> {
        if cdr.len() > PUBLISH_MAX {
            let (frame, bytes, max) = (frame::name(tag::PUBLISH), cdr.len() as u64, PUBLISH_MAX);
            return Err(LinkError::TooLong { peer: READER, frame, bytes, max });
        }
        self.send(tag::PUBLISH, index, cdr)
    }

    /// Sends what an earlier call could not send completely. Call it now and then.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the ingress has ended.
    pub fn flush(&self) -> Result<(), LinkError> {
        self.queue().flush(&self.0.socket, INGRESS)
    }

    fn send(&self, tag: u8, number: u32, cdr: &[u8]) -> Result<(), LinkError> {
        let mut queue = self.queue();
        queue.flush(&self.0.socket, INGRESS)?;
        if queue.bytes() + HEAD + 4 + cdr.len() > QUEUE_BYTES {
            return Err(LinkError::Full { peer: INGRESS });
        }
        queue.push(frame::encode(tag, &[&number.to_le_bytes(), cdr].concat()), None);
        queue.flush(&self.0.socket, INGRESS)
    }

    fn queue(&self) -> MutexGuard<'_, FrameQueue> {
        self.0.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
