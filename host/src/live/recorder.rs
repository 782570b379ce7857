//! Sends every wake to the recorder without blocking, and after a restart of the recorder to the
//! next one.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_journal::{JournalHeader, LogDigest};
use gleaner_lambda::Decision;
use gleaner_protocol::LinkLosses;
use gleaner_protocol::link::{LinkError, RecorderLink};

use crate::api::data::{Topic, Wake};
use crate::journal::EntryBuilder;

/// Timeout of the recorder's start: on a busy machine, with a large preroll to allocate. Clips of
/// an earlier recorder are recovered afterwards.
const READY: Duration = Duration::from_secs(120);
/// Timeout of the last wakes.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time without a recorder after which the run ends: twice the longest delay before a restart.
const REJOIN: Duration = Duration::from_secs(60);

/// The lambda's end of the link, and the builder of its entries.
pub(super) struct RecorderSender {
    link: RecorderLink,
    entry_builder: EntryBuilder,
    /// The identity of the lambda, with the engine that was sent.
    header: JournalHeader,
    /// True if the starter passes a connection to the next recorder.
    has_starter: bool,
    /// Time at which the run ends, while there is no recorder.
    until: Option<Instant>,
}

impl RecorderSender {
    /// Registers the lambda, and waits until the recorder is ready for it. `has_starter` is true if
    /// the starter passes a connection to the next recorder if this one ends.
    pub(super) fn join(
        socket: OwnedFd,
        header: JournalHeader,
        inputs: &[Arc<Topic>],
        has_starter: bool,
    ) -> Result<Self, Failure> {
        let mut link = RecorderLink::new(socket);
        link.hello(&header, READY).map_err(failed)?;
        let entry_builder = EntryBuilder::new(inputs);
        Ok(Self { link, entry_builder, header, has_starter, until: None })
    }

    /// Joins the next recorder.
    pub(super) fn rejoin(&mut self, socket: OwnedFd) -> Result<(), Failure> {
        self.until = Some(Instant::now() + REJOIN);
        self.link.rejoin(socket, &self.header).map_err(failed)
    }

    /// Notes the state of the inputs; call it before each wake.
    pub(super) fn begin(&mut self, wake: &Wake) {
        self.entry_builder.begin(wake);
    }

    /// Sends a wake; call it after each. `decided_ns` is the CLOCK_MONOTONIC at which the lambda
    /// returned.
    pub(super) fn end(
        &mut self,
        decision: &Decision,
        digest: LogDigest,
        decided_ns: i64,
    ) -> Result<(), Failure> {
        let entry = self.entry_builder.end(decision, digest);
        let sent = self.link.wake(entry, decided_ns);
        sent.or_else(|error| self.ended(error))
    }

    /// Sends the engine with the next wakes if it has changed.
    pub(super) fn engine(&mut self, engine: String) {
        if engine != self.header.engine {
            self.link.engine(&engine);
            self.header.engine = engine;
        }
    }

    /// Sends what waits; call it regularly.
    pub(super) fn poll(&mut self) -> Result<(), Failure> {
        self.link.poll().map(drop).or_else(|error| self.ended(error))?;
        if self.link.is_joined() {
            self.until = None;
        } else if self.until.is_some_and(|until| Instant::now() >= until) {
            return Err(failed(LinkError::Silent { seconds: REJOIN.as_secs() }));
        }
        Ok(())
    }

    /// Handles an error of the link: without a recorder, wakes are queued for the next one.
    fn ended(&mut self, error: LinkError) -> Result<(), Failure> {
        if !self.has_starter || !matches!(error, LinkError::Gone { .. }) {
            return Err(failed(error));
        }
        self.until.get_or_insert_with(|| Instant::now() + REJOIN);
        Ok(())
    }

    /// Wakes and triggers that could not be sent.
    pub(super) fn dropped(&self) -> LinkLosses {
        self.link.dropped()
    }

    /// Closes the link; returns what could not be sent.
    pub(super) fn leave(self) -> LinkLosses {
        self.link.bye(PATIENCE)
    }
}

fn failed(error: LinkError) -> Failure {
    Failure::caused_by(Exit::Internal, "cannot send wakes to the recorder", &error)
}
