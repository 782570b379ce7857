//! The control connection, from the program that starts the recorder to the recorder.

use std::collections::VecDeque;
use std::io::{self, BufReader, IoSlice, IoSliceMut, Read};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;

use rustix::io::Errno;
use rustix::net::{
    RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, recvmsg, send, sendmsg,
};
use serde::{Deserialize, Serialize};

use super::LinkError;
use super::frame::{self, tag};
use gleaner_lambda::manifest::Limits;

const STARTER: &str = "the starter";
const RECORDER: &str = "the recorder";

/// Maximum number of received sockets that wait for their frame. Each frame has one.
const SOCKETS: usize = 16;

/// Adds a lambda to the recorder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddLambda {
    /// Folder of the lambda. Its `build/` has the manifest, from which the recorder takes the name
    /// and `[record]`: the lambda's process cannot change them.
    pub lambda: PathBuf,
    /// Remapped topics, from and to.
    pub remaps: Vec<(String, String)>,
    /// The limits of this vehicle. Of each limit, the smaller of this value and the one in the
    /// manifest applies.
    pub most: Limits,
    /// Topics of its `[record]`, by their names on the network, and the ids under which the ingress
    /// grants them to the recorder. A topic has one id for as long as the recorder lives.
    #[serde(default)]
    pub grants: Vec<(String, u32)>,
}

/// The starter's end of the control connection.
#[derive(Debug)]
pub struct ControlClient {
    socket: UnixStream,
}

impl ControlClient {
    /// Creates a connection; also returns the standard input of the recorder.
    ///
    /// # Errors
    ///
    /// Errors of the system, such as too many open files.
    pub fn pair() -> io::Result<(ControlClient, OwnedFd)> {
        let (starter_end, recorder_end) = UnixStream::pair()?;
        Ok((ControlClient { socket: starter_end }, recorder_end.into()))
    }

    /// Adds a lambda to the recorder; returns the socket for the lambda's process.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the recorder has ended, [`LinkError::Socket`] if there are too many
    /// open files.
    pub fn add(&mut self, add: &AddLambda) -> Result<OwnedFd, LinkError> {
        let failed = |source| LinkError::Socket { peer: RECORDER, source };
        let (lambda_end, recorder_end) = UnixStream::pair().map_err(failed)?;
        let payload = serde_json::to_vec(add).map_err(|error| failed(error.into()))?;
        let bytes = frame::encode(tag::ADD, &payload);
        if payload.len() > super::FRAME_MAX {
            return Err(LinkError::TooLong {
                peer: STARTER,
                frame: "add",
                bytes: payload.len() as u64,
            });
        }
        // The socket is sent with the first bytes, so that it arrives before the frame is complete.
        let fds = [recorder_end.as_fd()];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut ancillary = SendAncillaryBuffer::new(&mut space);
        ancillary.push(SendAncillaryMessage::ScmRights(&fds));
        let sent = loop {
            match sendmsg(
                &self.socket,
                &[IoSlice::new(&bytes)],
                &mut ancillary,
                SendFlags::NOSIGNAL,
            ) {
                Ok(sent) => break sent,
                Err(Errno::INTR) => {}
                Err(error) => return Err(LinkError::of(RECORDER, error)),
            }
        };
        self.send(&bytes[sent..])?;
        Ok(lambda_end.into())
    }

    /// Requests the recorder to complete open clips and exit.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it has ended.
    pub fn stop(&mut self) -> Result<(), LinkError> {
        self.send(&frame::encode(tag::STOP, &[]))
    }

    /// Sends all of `bytes`. A recorder that has ended is an error, not a signal.
    fn send(&self, mut bytes: &[u8]) -> Result<(), LinkError> {
        while !bytes.is_empty() {
            match send(&self.socket, bytes, SendFlags::NOSIGNAL) {
                Ok(sent) => bytes = &bytes[sent..],
                Err(Errno::INTR) => {}
                Err(error) => return Err(LinkError::of(RECORDER, error)),
            }
        }
        Ok(())
    }
}

/// A request of the starter.
#[derive(Debug)]
pub enum ControlMessage {
    /// Add a lambda, with its socket.
    Add(AddLambda, OwnedFd),
    /// Complete open clips and exit.
    Stop,
}

/// The recorder's end of the control connection.
#[derive(Debug)]
pub struct ControlServer {
    from: BufReader<Receiver>,
    payload: Vec<u8>,
}

impl ControlServer {
    /// Creates the server from the socket that is the recorder's standard input.
    pub fn new(socket: OwnedFd) -> ControlServer {
        let receiver = Receiver { socket, received: VecDeque::new() };
        ControlServer { from: BufReader::new(receiver), payload: Vec::new() }
    }

    /// Waits for the next request. `None` when the starter has ended.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the invalid frame; nothing can be read after it.
    pub fn receive(&mut self) -> Result<Option<ControlMessage>, LinkError> {
        match frame::read(&mut self.from, &mut self.payload, STARTER)? {
            None => Ok(None),
            Some(tag::STOP) => Ok(Some(ControlMessage::Stop)),
            Some(tag::ADD) => {
                let add = serde_json::from_slice(&self.payload).map_err(|error| {
                    LinkError::Malformed { peer: STARTER, frame: "add", reason: error.to_string() }
                })?;
                let socket = self.from.get_mut().received.pop_front().ok_or(LinkError::NoSocket)?;
                Ok(Some(ControlMessage::Add(add, socket)))
            }
            Some(tag) => Err(LinkError::Unknown { peer: STARTER, tag }),
        }
    }
}

/// Reads bytes, and keeps the sockets that come with them.
#[derive(Debug)]
struct Receiver {
    socket: OwnedFd,
    received: VecDeque<OwnedFd>,
}

impl Read for Receiver {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut ancillary = RecvAncillaryBuffer::new(&mut space);
        let flags = RecvFlags::CMSG_CLOEXEC;
        let bytes =
            recvmsg(&self.socket, &mut [IoSliceMut::new(buffer)], &mut ancillary, flags)?.bytes;
        for message in ancillary.drain() {
            if let RecvAncillaryMessage::ScmRights(sockets) = message {
                // Excess sockets are closed.
                let room = SOCKETS.saturating_sub(self.received.len());
                self.received.extend(sockets.take(room));
            }
        }
        Ok(bytes)
    }
}
