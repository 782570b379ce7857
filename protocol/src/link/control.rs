//! The control connection, from the program that starts the recorder to the recorder.

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::frame::{self, tag};
use super::{FrameReceiver, LinkError, STARTER, send_frame, send_json};
use gleaner_lambda::manifest::Limits;

const RECORDER: &str = "the recorder";

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
        send_json(&self.socket, tag::ADD, add, &[recorder_end.as_fd()], RECORDER)?;
        Ok(lambda_end.into())
    }

    /// Requests the recorder to complete open clips and exit once the lambdas have ended.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it has ended.
    pub fn stop(&mut self) -> Result<(), LinkError> {
        send_frame(&self.socket, &frame::encode(tag::STOP, &[]), &[], RECORDER)
    }

    /// As [`stop`](Self::stop), while the lambdas run on: they join another recorder.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it has ended.
    pub fn give_way(&mut self) -> Result<(), LinkError> {
        send_frame(&self.socket, &frame::encode(tag::GIVE_WAY, &[]), &[], RECORDER)
    }
}

/// A request of the starter.
#[derive(Debug)]
pub enum ControlMessage {
    /// Add a lambda, with its socket.
    Add(Box<AddLambda>, OwnedFd),
    /// Complete open clips and exit once the lambdas have ended.
    Stop,
    /// Complete open clips and exit: the lambdas join another recorder.
    GiveWay,
}

/// The recorder's end of the control connection.
#[derive(Debug)]
pub struct ControlServer {
    socket: OwnedFd,
    frames: FrameReceiver,
}

impl ControlServer {
    /// Creates the server from the socket that is the recorder's standard input.
    pub fn new(socket: OwnedFd) -> ControlServer {
        ControlServer { socket, frames: FrameReceiver::new(STARTER, 1) }
    }

    /// Waits for the next request. `None` when the starter has ended.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the invalid frame; nothing can be read after it.
    pub fn receive(&mut self) -> Result<Option<ControlMessage>, LinkError> {
        let Some(mut received) = self.frames.wait(&self.socket)? else { return Ok(None) };
        match received.tag {
            tag::STOP => Ok(Some(ControlMessage::Stop)),
            tag::GIVE_WAY => Ok(Some(ControlMessage::GiveWay)),
            tag::ADD => {
                let add = received.json(STARTER)?;
                Ok(Some(ControlMessage::Add(add, received.descriptor()?)))
            }
            tag => Err(LinkError::Unknown { peer: STARTER, tag }),
        }
    }
}
