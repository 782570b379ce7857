//! Sends every wake to the recorder without blocking, and after a restart of the recorder to the
//! next one. Without a recorder, the lambda decides, and what would be recorded is lost.

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
/// Time for which wakes are kept without a recorder: twice the longest delay before a restart. The
/// next one refuses wakes of more than a minute before.
const KEPT: Duration = Duration::from_secs(60);

/// The lambda's end of the link, and the builder of its entries.
pub(super) struct RecorderSender {
    link: RecorderLink,
    entry_builder: EntryBuilder,
    /// The identity of the lambda, with the engine that was sent.
    header: JournalHeader,
    /// True if the starter passes a connection to the next recorder.
    has_starter: bool,
    /// Time since which there is no recorder.
    absent: Option<Instant>,
    /// Set while wakes are not kept for the next recorder.
    loses: bool,
}

impl RecorderSender {
    /// Registers the lambda, and waits until the recorder is ready for it. `has_starter` is true if
    /// the starter passes a connection to the next recorder if this one has ended, or ends later.
    pub(super) fn join(
        socket: OwnedFd,
        header: JournalHeader,
        inputs: &[Arc<Topic>],
        has_starter: bool,
    ) -> Result<Self, Failure> {
        let mut link = RecorderLink::new(socket);
        let joined = link.hello(&header, READY);
        let entry_builder = EntryBuilder::new(inputs);
        let mut sender =
            Self { link, entry_builder, header, has_starter, absent: None, loses: false };
        joined.or_else(|error| sender.ended(error))?;
        Ok(sender)
    }

    /// Joins the next recorder.
    pub(super) fn rejoin(&mut self, socket: OwnedFd) -> Result<(), Failure> {
        self.absent.get_or_insert_with(Instant::now);
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

    /// Sends what waits, or drops it after a minute without a recorder; call it regularly.
    pub(super) fn poll(&mut self) -> Result<(), Failure> {
        self.link.poll().map(drop).or_else(|error| self.ended(error))?;
        if self.link.is_joined() {
            (self.absent, self.loses) = (None, false);
        } else if self.absent.is_some_and(|since| since.elapsed() >= KEPT) {
            if !std::mem::replace(&mut self.loses, true) {
                tracing::warn!("no recorder is connected: wakes and triggers are lost");
            }
            self.link.drop_queued();
        }
        Ok(())
    }

    /// Handles an error of the link: without a recorder, wakes are queued for the next one.
    fn ended(&mut self, error: LinkError) -> Result<(), Failure> {
        let is_absent = matches!(error, LinkError::Gone { .. } | LinkError::Silent { .. });
        if !self.has_starter || !is_absent {
            return Err(failed(error));
        }
        self.absent.get_or_insert_with(Instant::now);
        Ok(())
    }

    /// Wakes and triggers that could not be sent.
    pub(super) fn dropped(&self) -> LinkLosses {
        LinkLosses { absent_s: self.absent_s(), ..self.link.dropped() }
    }

    /// Closes the link; returns what could not be sent.
    pub(super) fn leave(self) -> LinkLosses {
        LinkLosses { absent_s: self.absent_s(), ..self.link.bye(PATIENCE) }
    }

    fn absent_s(&self) -> u64 {
        self.absent.map_or(0, |since| since.elapsed().as_secs())
    }
}

fn failed(error: LinkError) -> Failure {
    Failure::caused_by(Exit::Internal, "cannot send wakes to the recorder", &error)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::net::UnixStream;

    use gleaner_journal::TimeRange;
    use gleaner_lambda::BuildDir;
    use gleaner_lambda::manifest::Manifest;

    use super::*;
    use crate::api::data::Tick;
    use crate::journal::LambdaIdentity;
    use crate::test_decision::triggered;

    const MANIFEST: &str = "schedule.period = '1s'\n\
        [lambda]\nname = 'a'\nversion = '0.1.0'\nkind = 'wasm'\nentry = 'a.wasm'\n";

    fn header() -> JournalHeader {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("build")).unwrap();
        fs::write(folder.path().join("build/lambda.toml"), MANIFEST).unwrap();
        let identity = LambdaIdentity {
            manifest: &Manifest::parse(MANIFEST, "lambda.toml").unwrap(),
            build: &BuildDir::of(folder.path()),
            config: &[],
            remaps: &[],
            engine: "a test".to_owned(),
            clock: "a clock",
            part: TimeRange::default(),
        };
        identity.header().unwrap()
    }

    fn wake(sender: &mut RecorderSender, at_ns: i64) {
        sender.begin(&Wake::Tick(Tick { at_ns, missed: 0 }));
        sender.end(&triggered(at_ns), LogDigest::default(), at_ns).unwrap();
        sender.poll().unwrap();
    }

    #[test]
    fn triggers_are_lost_after_a_minute_without_a_recorder() {
        let (closed, _) = UnixStream::pair().unwrap();
        let mut sender = RecorderSender::join(closed.into(), header(), &[], true).unwrap();
        wake(&mut sender, 1);
        assert_eq!(sender.dropped().triggers_lost, 0, "it is kept");
        sender.absent = Instant::now().checked_sub(KEPT);
        for (at_ns, lost) in [(2, 2), (3, 3)] {
            wake(&mut sender, at_ns);
            let dropped = sender.dropped();
            assert_eq!((dropped.triggers_lost, dropped.absent_s), (lost, KEPT.as_secs()));
        }
        let (closed, _) = UnixStream::pair().unwrap();
        let alone = RecorderSender::join(closed.into(), header(), &[], false);
        assert!(alone.is_err(), "without a starter, there is no next recorder");
    }
}
