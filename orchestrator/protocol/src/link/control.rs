//! From whoever starts the recorder to the recorder.

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

/// Sockets that were received and not yet asked for. There is one in each frame.
const SOCKETS: usize = 16;

/// A lambda that the recorder is to hear.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddLambda {
    /// Its folder. The manifest in its `build/` says its name and what it records, not the lambda's
    /// process.
    pub lambda: PathBuf,
    /// Other names for topics of the manifest, from and to.
    pub remaps: Vec<(String, String)>,
    /// The most that a lambda gets on this vehicle: the limits of its manifest count as far as they
    /// are smaller.
    pub most: Limits,
}

/// The starter's end.
#[derive(Debug)]
pub struct ControlClient {
    socket: UnixStream,
}

impl ControlClient {
    /// A new connection, and what becomes the recorder's standard input.
    ///
    /// # Errors
    ///
    /// What the system says: too many open files.
    pub fn pair() -> io::Result<(ControlClient, OwnedFd)> {
        let (ours, theirs) = UnixStream::pair()?;
        Ok((ControlClient { socket: ours }, theirs.into()))
    }

    /// Has the recorder hear a lambda; returns the socket that the lambda's process is to be given.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the recorder has ended, [`LinkError::Socket`] if there are too many
    /// open files.
    pub fn add(&mut self, add: &AddLambda) -> Result<OwnedFd, LinkError> {
        let failed = |source| LinkError::Socket { who: RECORDER, source };
        let (ours, theirs) = UnixStream::pair().map_err(failed)?;
        let payload = serde_json::to_vec(add).map_err(|error| failed(error.into()))?;
        let bytes = frame::whole(tag::ADD, &payload);
        if payload.len() > super::FRAME_MAX {
            return Err(LinkError::TooLong {
                who: STARTER,
                frame: "add",
                bytes: payload.len() as u64,
            });
        }
        // With the first of its bytes, so that it is there when the frame is.
        let fds = [theirs.as_fd()];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut with = SendAncillaryBuffer::new(&mut space);
        with.push(SendAncillaryMessage::ScmRights(&fds));
        let sent = loop {
            match sendmsg(&self.socket, &[IoSlice::new(&bytes)], &mut with, SendFlags::NOSIGNAL) {
                Ok(sent) => break sent,
                Err(Errno::INTR) => {}
                Err(error) => return Err(LinkError::of(RECORDER, error)),
            }
        };
        self.send(&bytes[sent..])?;
        Ok(ours.into())
    }

    /// Has the recorder complete what is open, and end.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it has ended already.
    pub fn stop(&mut self) -> Result<(), LinkError> {
        self.send(&frame::whole(tag::STOP, &[]))
    }

    /// All of `bytes`. A recorder that ended is an error, not a signal.
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

/// What the starter wants.
#[derive(Debug)]
pub enum ControlMessage {
    /// A lambda, and its socket.
    Add(AddLambda, OwnedFd),
    /// Complete what is open, and end.
    Stop,
}

/// The recorder's end.
#[derive(Debug)]
pub struct ControlServer {
    from: BufReader<Receiver>,
    payload: Vec<u8>,
}

impl ControlServer {
    /// Over this socket, which is the recorder's standard input.
    pub fn new(socket: OwnedFd) -> ControlServer {
        let receiver = Receiver { socket, received: VecDeque::new() };
        ControlServer { from: BufReader::new(receiver), payload: Vec::new() }
    }

    /// The next order; waits for it. `None` when the starter has ended.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the frame that makes no sense; nothing can be read after it.
    pub fn order(&mut self) -> Result<Option<ControlMessage>, LinkError> {
        match frame::read(&mut self.from, &mut self.payload, STARTER)? {
            None => Ok(None),
            Some(tag::STOP) => Ok(Some(ControlMessage::Stop)),
            Some(tag::ADD) => {
                let add = serde_json::from_slice(&self.payload).map_err(|error| {
                    LinkError::Malformed { who: STARTER, frame: "add", why: error.to_string() }
                })?;
                let socket = self.from.get_mut().received.pop_front().ok_or(LinkError::NoSocket)?;
                Ok(Some(ControlMessage::Add(add, socket)))
            }
            Some(tag) => Err(LinkError::Unknown { who: STARTER, tag }),
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
        let mut with = RecvAncillaryBuffer::new(&mut space);
        let flags = RecvFlags::CMSG_CLOEXEC;
        let bytes = recvmsg(&self.socket, &mut [IoSliceMut::new(buffer)], &mut with, flags)?.bytes;
        for message in with.drain() {
            if let RecvAncillaryMessage::ScmRights(sockets) = message {
                // Those that nobody wants are closed.
                let room = SOCKETS.saturating_sub(self.received.len());
                self.received.extend(sockets.take(room));
            }
        }
        Ok(bytes)
    }
}
