//! The connection of a lambda's process to `gleaner-inference`.

use std::os::fd::OwnedFd;

use gleaner_protocol::inference::{AddClient, report_state};
use gleaner_protocol::link::LinkError;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

/// A lambda's process.
pub(super) struct Client {
    pub(super) add: AddClient,
    /// The end of `gleaner-inference` of its connection.
    pub(super) socket: OwnedFd,
    /// The newest state of the process, while the connection has no room for it.
    unsent: Option<ProcessState>,
}

/// A state of `gleaner-inference`. Each replaces those before: a lambda opens its models again
/// after either of them.
pub(super) enum ProcessState {
    Started,
    /// It has ended, for this reason.
    Ended(String),
}

impl Client {
    pub(super) fn new(add: AddClient, socket: OwnedFd) -> Self {
        Self { add, socket, unsent: None }
    }

    /// Sends a state of the process, at once or once the lambda has read earlier ones. Returns
    /// whether the lambda's process still runs.
    pub(super) fn report(&mut self, state: ProcessState) -> bool {
        self.unsent = Some(state);
        self.send_state()
    }

    /// Sends the state that had no room.
    pub(super) fn send_state(&mut self) -> bool {
        let reason = match &self.unsent {
            Some(ProcessState::Ended(reason)) => Some(reason.as_str()),
            Some(ProcessState::Started) => None,
            None => return true,
        };
        match report_state(&self.socket, reason) {
            Ok(()) => self.unsent = None,
            Err(LinkError::Gone { .. }) => return false,
            // It does not read, or the system has no memory: the caller tries again.
            Err(_) => {}
        }
        true
    }

    /// Returns whether a state has had no room yet.
    pub(super) fn has_unsent(&self) -> bool {
        self.unsent.is_some()
    }

    /// Returns whether the lambda's process has closed its end of the connection.
    pub(super) fn has_ended(&self) -> bool {
        let mut polled = [PollFd::new(&self.socket, PollFlags::empty())];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut polled, Some(&now)).is_ok() && polled[0].revents().contains(PollFlags::HUP)
    }
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::inference::{ModelClient, ModelResult};

    use super::*;

    #[test]
    fn a_lambda_that_does_not_read_keeps_its_connection_and_reads_the_last_state_at_the_end() {
        let (lambda, socket) = ModelClient::pair().unwrap();
        let add = AddClient { name: "busy".to_owned(), ..AddClient::default() };
        let mut client = Client::new(add, socket);
        while !client.has_unsent() {
            assert!(client.report(ProcessState::Ended("it has ended".to_owned())));
        }
        assert!(client.report(ProcessState::Started));
        let mut lambda = ModelClient::new(lambda);
        let mut last = None;
        while let Some(reply) = lambda.poll().unwrap() {
            last = Some(reply.result);
            assert!(client.send_state());
        }
        assert_eq!(last, Some(Ok(ModelResult::Started)));
        assert!(!client.has_unsent() && !client.has_ended());
        drop(lambda);
        assert!(client.has_ended() && !client.report(ProcessState::Started));
    }
}
