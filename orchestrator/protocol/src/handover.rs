//! Connections that a starter passes to a program that it starts.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::io::Errno;
use serde::{Deserialize, Serialize};

use crate::link::frame::{self, tag};
use crate::link::{FrameReceiver, LinkError, send_frame};

const STARTER: &str = "the starter";
const PROGRAM: &str = "the started program";

/// Connections that a starter passes to a program over the socket that is its standard input.
///
/// The socket stays open: a later message can replace a connection, for example after a restart of
/// the ingress. Such a message has only those connections that are replaced.
#[derive(Debug, Default)]
pub struct Handover {
    /// Requests of the starter, to the recorder or the ingress.
    pub control: Option<OwnedFd>,
    /// The reader's end of its connection to the ingress.
    pub ingress: Option<OwnedFd>,
    /// The lambda's end of its connection to the recorder.
    pub recorder: Option<OwnedFd>,
}

/// Name of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum ConnectionName {
    Control,
    Ingress,
    Recorder,
}

/// Largest number of connections in a message.
const CONNECTIONS: usize = 3;

impl Handover {
    /// Sends the connections. It waits while the other side does not read an earlier message.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the program has ended.
    pub fn send(&self, socket: impl AsFd) -> Result<(), LinkError> {
        let all = [
            (ConnectionName::Control, &self.control),
            (ConnectionName::Ingress, &self.ingress),
            (ConnectionName::Recorder, &self.recorder),
        ];
        let (names, descriptors): (Vec<ConnectionName>, Vec<BorrowedFd<'_>>) =
            all.iter().filter_map(|(name, fd)| Some((*name, fd.as_ref()?.as_fd()))).unzip();
        let payload = serde_json::to_vec(&names)
            .map_err(|error| LinkError::Socket { peer: PROGRAM, source: error.into() })?;
        send_frame(&socket, &frame::encode(tag::HANDOVER, &payload), &descriptors, PROGRAM)
    }

    /// Waits for the next message of the starter.
    ///
    /// Exactly one message is read, so that the next call finds the next one. To find out whether
    /// there is one, poll the socket: a message is sent as a whole.
    ///
    /// # Errors
    ///
    /// [`LinkError::NoStarter`] if `socket` is no socket, [`LinkError::Gone`] if the starter has
    /// ended, [`LinkError::Malformed`] for names that do not match the descriptors.
    pub fn receive(socket: impl AsFd) -> Result<Handover, LinkError> {
        let received = FrameReceiver::new(STARTER, CONNECTIONS).wait(socket);
        let frame = match received {
            Ok(Some(frame)) => frame,
            Ok(None) => return Err(LinkError::Gone { peer: STARTER }),
            Err(LinkError::Socket { source, .. })
                if source.raw_os_error() == Some(Errno::NOTSOCK.raw_os_error()) =>
            {
                return Err(LinkError::NoStarter);
            }
            Err(error) => return Err(error),
        };
        if frame.tag != tag::HANDOVER {
            return Err(LinkError::Unknown { peer: STARTER, tag: frame.tag });
        }
        let malformed = |reason| LinkError::Malformed { peer: STARTER, frame: "handover", reason };
        let names: Vec<ConnectionName> = frame.json(STARTER)?;
        let (named, descriptors) = (names.len(), frame.descriptors.len());
        if named != descriptors {
            let reason = format!("it names {named} connections and has {descriptors} descriptors");
            return Err(malformed(reason));
        }
        let mut handover = Handover::default();
        for (name, descriptor) in names.into_iter().zip(frame.descriptors) {
            let connection = match name {
                ConnectionName::Control => &mut handover.control,
                ConnectionName::Ingress => &mut handover.ingress,
                ConnectionName::Recorder => &mut handover.recorder,
            };
            if connection.replace(descriptor).is_some() {
                return Err(malformed(format!("it names {name:?} twice").to_lowercase()));
            }
        }
        Ok(handover)
    }

    /// Takes the connection `control`.
    ///
    /// # Errors
    ///
    /// [`LinkError::NoConnection`] if the starter did not pass it.
    pub fn take_control(&mut self) -> Result<OwnedFd, LinkError> {
        self.control.take().ok_or(LinkError::NoConnection { name: "control" })
    }

    /// Takes the connection `ingress`.
    ///
    /// # Errors
    ///
    /// [`LinkError::NoConnection`] if the starter did not pass it.
    pub fn take_ingress(&mut self) -> Result<OwnedFd, LinkError> {
        self.ingress.take().ok_or(LinkError::NoConnection { name: "ingress" })
    }
}
