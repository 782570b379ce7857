//! The recorder, as the lambda's side of the socket sees it: every wake is told, and nothing here
//! waits for it.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_journal::{Header, Said};
use gleaner_lambda::Decision;
use gleaner_protocol::ToRecorder as Dropped;
use gleaner_protocol::link::{LinkError, RecorderLink};

use crate::api::data::{Topic, Wake};
use crate::journal::Scribe;

/// How long the recorder may take to get ready: on a busy machine, with a large preroll to take
/// from the system. What an earlier one left it recovers afterwards.
const READY: Duration = Duration::from_secs(120);
/// How long it may take for the last wakes.
const PATIENCE: Duration = Duration::from_secs(10);

/// The lambda's end, and what fills in the wakes.
pub(super) struct ToRecorder {
    link: RecorderLink,
    scribe: Scribe,
}

impl ToRecorder {
    /// Says which lambda this is, and waits until the recorder is ready for it.
    pub(super) fn join(
        socket: OwnedFd,
        header: &Header,
        inputs: &[Arc<Topic>],
    ) -> Result<Self, Failure> {
        let mut link = RecorderLink::new(socket);
        link.hello(header, READY).map_err(failed)?;
        Ok(Self { link, scribe: Scribe::new(inputs) })
    }

    /// Before a wake.
    pub(super) fn begin(&mut self, wake: &Wake) {
        self.scribe.begin(wake);
    }

    /// After a wake. `decided_ns` is the CLOCK_MONOTONIC at which the lambda was left.
    pub(super) fn end(
        &mut self,
        decision: &Decision,
        said: Said,
        decided_ns: i64,
    ) -> Result<(), Failure> {
        let entry = self.scribe.end(decision, said);
        self.link.wake(entry, decided_ns).map_err(failed)
    }

    /// Now and then: sends what waits.
    pub(super) fn poll(&mut self) -> Result<(), Failure> {
        self.link.poll().map(drop).map_err(failed)
    }

    /// What could not be told.
    pub(super) fn dropped(&self) -> Dropped {
        self.link.dropped()
    }

    /// Says good-bye, and what could not be told.
    pub(super) fn leave(self) -> Dropped {
        self.link.bye(PATIENCE)
    }
}

fn failed(error: LinkError) -> Failure {
    Failure::caused_by(Exit::Internal, "the recorder cannot be told of wakes", &error)
}
