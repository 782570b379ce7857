//! The worker's side: wakes the lambda, and sends what came of it.

use std::fs::File;
use std::io::{self, Write};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use gleaner_base::Exit;
use gleaner_lambda::Fault;
use gleaner_protocol::Layer;
use gleaner_vitals::usage;

use super::{Called, Done, Message, Woken};
use crate::api::Session;
use crate::api::data::Wake;
use crate::guest::{Guest, Outcome, Totals};

/// The writing end of a worker's messages.
#[derive(Clone)]
pub struct Reports(Arc<Mutex<Writer>>);

struct Writer {
    file: File,
    /// Messages that go out with the next one that ends a call.
    pending: Vec<u8>,
    is_ready: bool,
}

impl Reports {
    /// Messages to the process that reads the other end of `file`.
    pub fn to(file: File) -> Self {
        Self(Arc::new(Mutex::new(Writer { file, pending: Vec::new(), is_ready: false })))
    }

    /// Whether code of the lambda may have run: from then on, only messages count.
    pub fn is_ready(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_ready
    }

    /// Sends what is known once the course is over.
    pub fn done(&self, totals: Totals) {
        let Totals { counts, decode_ns, curves, curves_omitted } = totals;
        self.send(&Message::Done(Done { counts, decode_ns, curves: curves.len(), curves_omitted }));
        curves.into_iter().for_each(|curve| self.send(&Message::Curve(curve)));
    }

    fn add(&self, message: &Message) {
        let pending = &mut self.0.lock().unwrap_or_else(PoisonError::into_inner).pending;
        serde_json::to_writer(&mut *pending, message).expect("a message is plain data");
        pending.push(b'\n');
    }

    /// Sends `message` behind those that were added, in one write: if this process ends in the next
    /// call, all of this one is known.
    fn send(&self, message: &Message) {
        self.add(message);
        let mut writer = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Writer { file, pending, .. } = &mut *writer;
        if file.write_all(pending).is_err() {
            // The process that wanted the outcome has ended: nothing is left to do here.
            std::process::exit(Exit::Internal.code().into());
        }
        pending.clear();
    }
}

impl io::Write for Reports {
    /// Discards what a job reports: the process that reads the messages makes the reports itself.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A guest whose outcomes are sent.
pub struct Sender {
    guest: Box<dyn Guest>,
    session: Session,
    reports: Reports,
    is_prepared: bool,
    /// Dropped and refused so far, as counted when the last call ended.
    log_dropped: u64,
    triggers_refused: u64,
}

impl Sender {
    /// Sends that `guest`, over `session`, is ready within `layers`, before anything of the lambda
    /// has run.
    pub fn begin(
        guest: Box<dyn Guest>,
        session: Session,
        reports: Reports,
        layers: Vec<Layer>,
    ) -> Self {
        reports.send(&Message::Ready { engine: guest.engine(), layers });
        reports.0.lock().unwrap_or_else(PoisonError::into_inner).is_ready = true;
        Self { guest, session, reports, is_prepared: false, log_dropped: 0, triggers_refused: 0 }
    }

    /// Adds the log of a call that has ended, behind the first `before` lines.
    fn called(&mut self, result: &Result<(), Fault>, before: usize) -> Called {
        let (lines, said) = self.session.lines_behind(before);
        for line in lines {
            self.reports.add(&Message::Log { level: line.level, message: line.message });
        }
        let (dropped, refused) = (self.session.log_dropped(), self.session.triggers_refused());
        Called {
            fault: result.as_ref().err().cloned(),
            said: (said.lines.into(), said.digest),
            log_dropped: dropped - std::mem::replace(&mut self.log_dropped, dropped),
            triggers_refused: refused - std::mem::replace(&mut self.triggers_refused, refused),
            resident_bytes: 0,
        }
    }

    fn started(&mut self, result: &Result<(), Fault>, before: usize) -> Called {
        Called { resident_bytes: usage::resident(), ..self.called(result, before) }
    }
}

impl Guest for Sender {
    fn prepare(&mut self) -> Result<(), Fault> {
        let before = self.session.lines();
        let result = self.guest.prepare();
        self.is_prepared = true;
        let called = self.started(&result, before);
        self.reports.send(&Message::Prepared(called));
        result
    }

    fn init(&mut self) -> Result<(), Fault> {
        if !self.is_prepared {
            self.prepare()?;
        }
        let before = self.session.lines();
        let result = self.guest.init();
        let called = self.started(&result, before);
        self.reports.send(&Message::Initialised(called));
        result
    }

    fn wake(&mut self, wake: Wake) -> Outcome {
        let at_ns = wake.at_ns();
        let inputs = self.session.inputs();
        inputs.iter().for_each(|topic| topic.forget_looked());
        // What the host notes about the lambda, the process that reads the messages notes itself.
        let before = self.session.lines();
        let started = Instant::now();
        let outcome = self.guest.wake(wake);
        let run_ns = started.elapsed().as_nanos() as u64;
        let call = self.called(&outcome.result, before);
        let triggers = self.session.triggers();
        let looked = inputs.iter().map(|topic| topic.looked_back()).collect();
        let no_slot = inputs.iter().map(|topic| topic.counts().no_slot).sum();
        self.reports.send(&Message::Woken(Woken {
            at_ns,
            run_ns,
            call,
            triggers,
            looked,
            no_slot,
        }));
        outcome
    }

    fn engine(&self) -> String {
        self.guest.engine()
    }
}
