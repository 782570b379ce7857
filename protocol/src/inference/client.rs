//! The lambda's end of its connection.

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SendFlags, SocketFlags, SocketType, send, socketpair};

use super::server::receive;
use super::{INFERENCE, MESSAGE_MAX, ModelCall, ModelReply, ModelRequest, ModelResult};
use crate::link::LinkError;

/// The lambda's end of its connection to `gleaner-inference`: one call at a time.
#[derive(Debug)]
pub struct ModelClient {
    socket: OwnedFd,
    last_id: u64,
    /// Ids of the regions for inputs and for outputs that the caller has.
    regions: [u64; 2],
}

/// The reply to a call, if it came in time.
#[derive(Debug)]
pub enum ModelWait {
    /// The reply, with the region that came with it.
    Reply(ModelReply, Option<OwnedFd>),
    /// There was none by then. A later call ignores it, so the caller must forget its regions: the
    /// next replies bring them again.
    TimedOut,
}

impl ModelClient {
    /// Uses this end of the connection.
    pub fn new(socket: OwnedFd) -> ModelClient {
        ModelClient { socket, last_id: 0, regions: [0; 2] }
    }

    /// Creates a connection: the lambda's end and the other one.
    ///
    /// # Errors
    ///
    /// Errors of the system, such as too many open files.
    pub fn pair() -> io::Result<(OwnedFd, OwnedFd)> {
        let flags = SocketFlags::CLOEXEC;
        Ok(socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)?)
    }

    /// Returns the next message that the starter has sent: a reply with id 0.
    ///
    /// # Errors
    ///
    /// Those of [`call`](Self::call).
    pub fn poll(&mut self) -> Result<Option<ModelReply>, LinkError> {
        while let Some((reply, _)) = self.receive()? {
            if reply.id == 0 {
                // Regions of the next process may have the same ids.
                self.regions = [0; 2];
                return Ok(Some(reply));
            }
        }
        Ok(None)
    }

    /// Waits for the next message of the starter, until `until` if given; `None` if there is none
    /// by then.
    ///
    /// # Errors
    ///
    /// Those of [`call`](Self::call).
    pub fn wait_for_starter(
        &mut self,
        until: Option<Instant>,
    ) -> Result<Option<ModelReply>, LinkError> {
        loop {
            if let Some(reply) = self.poll()? {
                return Ok(Some(reply));
            }
            if !self.wait(PollFlags::IN, until)? {
                return Ok(None);
            }
        }
    }

    /// Sends a call and waits for the reply, until `until` if given. A reply with id 0 is an end of
    /// the process since the last [`poll`](Self::poll).
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the starter has ended, [`LinkError::TooLong`] for a call that exceeds
    /// a message, [`LinkError::Malformed`] for an invalid reply.
    pub fn call(
        &mut self,
        call: ModelCall,
        deadline_ns: Option<u64>,
        until: Option<Instant>,
    ) -> Result<ModelWait, LinkError> {
        self.last_id += 1;
        let regions = self.regions;
        let request = ModelRequest { id: self.last_id, deadline_ns, regions, call };
        let failed = |source| LinkError::Socket { peer: INFERENCE, source };
        let bytes = serde_json::to_vec(&request).map_err(|error| failed(error.into()))?;
        if bytes.len() > MESSAGE_MAX {
            let (frame, bytes) = ("call", bytes.len() as u64);
            return Err(LinkError::TooLong { peer: "the lambda", frame, bytes, max: MESSAGE_MAX });
        }
        // Until a reply confirms them.
        self.regions = [0; 2];
        loop {
            match send(&self.socket, &bytes, SendFlags::NOSIGNAL | SendFlags::DONTWAIT) {
                Ok(_) => break,
                Err(Errno::INTR) => {}
                // It does not read, for as long as it is being started again.
                Err(Errno::AGAIN) if !self.wait(PollFlags::OUT, until)? => {
                    return Ok(ModelWait::TimedOut);
                }
                Err(Errno::AGAIN) => {}
                Err(error) => return Err(LinkError::of(INFERENCE, error)),
            }
        }
        loop {
            if !self.wait(PollFlags::IN, until)? {
                return Ok(ModelWait::TimedOut);
            }
            if let Some((reply, region)) = self.receive()?
                && (reply.id == self.last_id || reply.id == 0)
            {
                if reply.id != 0 {
                    self.regions = regions;
                    match reply.result {
                        Ok(ModelResult::Reserved) => self.regions[0] = reply.region,
                        Ok(ModelResult::Ran { .. }) => self.regions[1] = reply.region,
                        _ => {}
                    }
                }
                return Ok(ModelWait::Reply(reply, region));
            }
        }
    }

    fn receive(&self) -> Result<Option<(ModelReply, Option<OwnedFd>)>, LinkError> {
        let Some((bytes, mut descriptors)) = receive(&self.socket, INFERENCE)? else {
            return Ok(None);
        };
        let malformed = |error: serde_json::Error| LinkError::Malformed {
            peer: INFERENCE,
            frame: "reply",
            reason: error.to_string(),
        };
        let reply = serde_json::from_slice(&bytes).map_err(malformed)?;
        Ok(Some((reply, descriptors.pop())))
    }

    /// Waits for an event of the socket; returns false at `until`.
    fn wait(&self, event: PollFlags, until: Option<Instant>) -> Result<bool, LinkError> {
        loop {
            let left = until.map(|until| until.saturating_duration_since(Instant::now()));
            let timeout = left.map(|left| {
                let left = left.min(Duration::from_secs(3600));
                Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() }
            });
            match poll(&mut [PollFd::new(&self.socket.as_fd(), event)], timeout.as_ref()) {
                Ok(0) if left.is_some_and(|left| left.is_zero()) => return Ok(false),
                Ok(0) | Err(Errno::INTR) => {}
                Ok(_) => return Ok(true),
                Err(error) => return Err(LinkError::of(INFERENCE, error)),
            }
        }
    }
}
