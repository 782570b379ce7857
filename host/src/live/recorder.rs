//! Sends every wake to the recorder without blocking.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::Duration;

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

/// The lambda's end of the link, and the builder of its entries.
pub(super) struct RecorderSender {
    link: RecorderLink,
    entry_builder: EntryBuilder,
    /// The engine that was sent.
    engine: String,
}

impl RecorderSender {
    /// Registers the lambda, and waits until the recorder is ready for it.
    pub(super) fn join(
        socket: OwnedFd,
        header: &JournalHeader,
        inputs: &[Arc<Topic>],
    ) -> Result<Self, Failure> {
        let mut link = RecorderLink::new(socket);
        link.hello(header, READY).map_err(failed)?;
        let engine = header.engine.clone();
        Ok(Self { link, entry_builder: EntryBuilder::new(inputs), engine })
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
        self.link.wake(entry, decided_ns).map_err(failed)
    }

    /// Sends the engine with the next wakes if it has changed.
    pub(super) fn engine(&mut self, engine: String) {
        if engine != self.engine {
            self.link.engine(&engine);
            self.engine = engine;
        }
    }

    /// Sends what waits; call it regularly.
    pub(super) fn poll(&mut self) -> Result<(), Failure> {
        self.link.poll().map(drop).map_err(failed)
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
