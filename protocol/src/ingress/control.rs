//! The control connection, from the program that starts the ingress to the ingress.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use gleaner_base::visible;

use super::{AddReader, AddTopics};
use crate::link::frame::{self, tag};
use crate::link::{
    FrameReceiver, Incoming, LinkError, ReceivedFrame, STARTER, send_frame, send_json,
};

const INGRESS: &str = "the ingress";

/// Maximum time that a request waits while the ingress does not read; it reads within seconds even
/// if it creates memory for many topics.
const TIMEOUT: Duration = Duration::from_secs(10);

/// The starter's end of the control connection. Its calls wait while the ingress does not read, up
/// to 10 s: then they fail with [`LinkError::Full`], and nothing may be sent after that.
#[derive(Debug)]
pub struct IngressControl {
    socket: UnixStream,
}

impl IngressControl {
    /// Creates a connection; also returns the end of the ingress.
    ///
    /// # Errors
    ///
    /// Errors of the system, such as too many open files.
    pub fn pair() -> io::Result<(IngressControl, OwnedFd)> {
        let (starter_end, ingress_end) = UnixStream::pair()?;
        starter_end.set_write_timeout(Some(TIMEOUT))?;
        Ok((IngressControl { socket: starter_end }, ingress_end.into()))
    }

    /// Adds a reader; returns the socket for its process.
    ///
    /// # Errors
    ///
    /// [`LinkError::Grant`] names the invalid field; nothing is sent then. [`LinkError::Gone`] if
    /// the ingress has ended, [`LinkError::Socket`] if there are too many open files.
    pub fn add_reader(&mut self, add: &AddReader) -> Result<OwnedFd, LinkError> {
        add.check().map_err(|source| LinkError::Grant { source })?;
        let failed = |source| LinkError::Socket { peer: INGRESS, source };
        let (reader_end, ingress_end) = UnixStream::pair().map_err(failed)?;
        send_json(&self.socket, tag::ADD_READER, add, &[ingress_end.as_fd()], INGRESS)?;
        Ok(reader_end.into())
    }

    /// Grants further topics to a reader.
    ///
    /// # Errors
    ///
    /// Those of [`add_reader`](Self::add_reader).
    pub fn add_topics(&mut self, add: &AddTopics) -> Result<(), LinkError> {
        add.check().map_err(|source| LinkError::Grant { source })?;
        send_json(&self.socket, tag::ADD_TOPICS, add, &[], INGRESS)
    }

    /// Requests the ingress to play its drive. Send it once all readers are ready.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the ingress has ended.
    pub fn begin(&mut self) -> Result<(), LinkError> {
        send_frame(&self.socket, &frame::encode(tag::BEGIN, &[]), &[], INGRESS)
    }

    /// Requests the ingress to exit.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it has ended.
    pub fn stop(&mut self) -> Result<(), LinkError> {
        send_frame(&self.socket, &frame::encode(tag::STOP, &[]), &[], INGRESS)
    }
}

/// A request of the starter to the ingress.
#[derive(Debug)]
pub enum IngressRequest {
    /// Add a reader, with its socket.
    AddReader(AddReader, OwnedFd),
    /// Grant further topics to a reader.
    AddTopics(AddTopics),
    /// Play the drive.
    Begin,
    /// Exit.
    Stop,
}

/// The ingress's end of the control connection. All grants that it returns are checked.
///
/// Its descriptor is readable when [`poll`](Self::poll) has something to read.
#[derive(Debug)]
pub struct IngressServer {
    socket: OwnedFd,
    frames: FrameReceiver,
}

impl IngressServer {
    /// Creates the server from its end of the connection.
    pub fn new(socket: OwnedFd) -> IngressServer {
        IngressServer { socket, frames: FrameReceiver::new(STARTER, 1) }
    }

    /// Waits for the next request. `None` when the starter has ended.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the invalid frame; nothing can be read after it, except after
    /// [`LinkError::Grant`] and [`LinkError::NoSocket`].
    pub fn receive(&mut self) -> Result<Option<IngressRequest>, LinkError> {
        self.frames.wait(&self.socket)?.map(request).transpose()
    }

    /// Returns the next request if it has arrived completely. Never waits. Call it until it returns
    /// no message.
    ///
    /// # Errors
    ///
    /// Those of [`receive`](Self::receive).
    pub fn poll(&mut self) -> Result<Incoming<IngressRequest>, LinkError> {
        self.frames.poll(&self.socket, request)
    }
}

impl AsFd for IngressServer {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

fn request(mut frame: ReceivedFrame) -> Result<IngressRequest, LinkError> {
    match frame.tag {
        tag::ADD_READER => {
            let add: AddReader = frame.json(STARTER)?;
            add.check().map_err(|source| LinkError::Grant { source })?;
            match frame.descriptor() {
                Ok(socket) => Ok(IngressRequest::AddReader(add, socket)),
                // The kernel discards it if no further file can be opened.
                Err(_) => Err(LinkError::NoSocket { reader: visible(&add.name) }),
            }
        }
        tag::ADD_TOPICS => {
            let add: AddTopics = frame.json(STARTER)?;
            add.check().map_err(|source| LinkError::Grant { source })?;
            Ok(IngressRequest::AddTopics(add))
        }
        tag::BEGIN => Ok(IngressRequest::Begin),
        tag::STOP => Ok(IngressRequest::Stop),
        tag => Err(LinkError::Unknown { peer: STARTER, tag }),
    }
}
