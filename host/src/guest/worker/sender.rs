//! The worker's side: runs the lambda's wakes, and sends their outcomes.

use std::fs::File;
use std::io::{self, Write};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use gleaner_base::Exit;
use gleaner_lambda::Fault;
use gleaner_protocol::Layer;
use gleaner_protocol::process_stats::usage;

use super::{CallOutcome, TotalsMessage, WakeMessage, WorkerMessage};
use crate::api::Session;
use crate::api::data::Wake;
use crate::guest::{Guest, LambdaEngine, Totals, WakeOutcome};

#[derive(Clone)]
pub struct MessageSender(Arc<Mutex<MessageWriter>>);

struct MessageWriter {
    file: File,
    /// Messages that are sent with the next one that ends a call.
    pending: Vec<u8>,
    is_ready: bool,
}

impl MessageSender {
    /// A sender to the process that reads the other end of `file`.
    pub fn to(file: File) -> Self {
        Self(Arc::new(Mutex::new(MessageWriter { file, pending: Vec::new(), is_ready: false })))
    }

    /// Returns whether code of the lambda may have run: from then on, only messages count.
    pub fn is_ready(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_ready
    }

    /// Sends the totals, after the last wake.
    pub fn done(&self, totals: Totals) {
        let Totals { counts, decode_ns, curves, curves_omitted } = totals;
        self.send(&WorkerMessage::Done(TotalsMessage {
            counts,
            decode_ns,
            curves: curves.len(),
            curves_omitted,
        }));
        curves.into_iter().for_each(|curve| self.send(&WorkerMessage::Curve(curve)));
    }

    fn add(&self, message: &WorkerMessage) {
        let pending = &mut self.0.lock().unwrap_or_else(PoisonError::into_inner).pending;
        serde_json::to_writer(&mut *pending, message).expect("a message is plain data");
        pending.push(b'\n');
    }

    /// Sends the added messages and `message` in one write: if the next call kills this process,
    /// the outcome of this call is complete.
    fn send(&self, message: &WorkerMessage) {
        self.add(message);
        let mut writer = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let MessageWriter { file, pending, .. } = &mut *writer;
        if file.write_all(pending).is_err() {
            // The parent has ended: nothing is left to do.
            std::process::exit(Exit::Internal.code().into());
        }
        pending.clear();
    }
}

impl io::Write for MessageSender {
    /// Discards the reports of a job: the parent writes the reports itself.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A guest whose outcomes are sent to the parent.
pub struct SendingGuest {
    guest: Box<dyn Guest>,
    session: Session,
    messages: MessageSender,
    is_prepared: bool,
    /// Counts at the end of the last call.
    log_dropped: u64,
    triggers_refused: u64,
}

impl SendingGuest {
    /// Reports that `guest`, over `session`, is ready within `layers`, before any code of the
    /// lambda has run.
    pub fn begin(
        guest: Box<dyn Guest>,
        session: Session,
        messages: MessageSender,
        layers: Vec<Layer>,
    ) -> Self {
        messages.send(&WorkerMessage::Ready { engine: guest.engine(), layers });
        messages.0.lock().unwrap_or_else(PoisonError::into_inner).is_ready = true;
        Self { guest, session, messages, is_prepared: false, log_dropped: 0, triggers_refused: 0 }
    }

    /// Adds the log lines of a call that has ended: those after the first `before` lines.
    fn called(&mut self, result: &Result<(), Fault>, before: usize) -> CallOutcome {
        let (lines, digest) = self.session.lines_behind(before);
        for line in lines {
            self.messages.add(&WorkerMessage::Log { level: line.level, message: line.message });
        }
        let (dropped, refused) = (self.session.log_dropped(), self.session.triggers_refused());
        CallOutcome {
            fault: result.as_ref().err().cloned(),
            said: (digest.lines.into(), digest.digest),
            log_dropped: dropped - std::mem::replace(&mut self.log_dropped, dropped),
            triggers_refused: refused - std::mem::replace(&mut self.triggers_refused, refused),
            resident_bytes: 0,
        }
    }

    fn started(&mut self, result: &Result<(), Fault>, before: usize) -> CallOutcome {
        CallOutcome { resident_bytes: usage::resident(), ..self.called(result, before) }
    }
}

impl Guest for SendingGuest {
    fn prepare(&mut self) -> Result<(), Fault> {
        let before = self.session.lines();
        let result = self.guest.prepare();
        self.is_prepared = true;
        let called = self.started(&result, before);
        self.messages.send(&WorkerMessage::Prepared(called));
        result
    }

    fn init(&mut self) -> Result<(), Fault> {
        if !self.is_prepared {
            self.prepare()?;
        }
        let before = self.session.lines();
        let result = self.guest.init();
        let called = self.started(&result, before);
        self.messages.send(&WorkerMessage::Initialised(called));
        result
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        let at_ns = wake.at_ns();
        let inputs = self.session.inputs();
        inputs.iter().for_each(|topic| topic.reset_look_back());
        // The parent adds the host's own warnings itself.
        let before = self.session.lines();
        let started = Instant::now();
        let outcome = self.guest.wake(wake);
        let run_ns = started.elapsed().as_nanos() as u64;
        let call = self.called(&outcome.result, before);
        let triggers = self.session.triggers();
        let looked = inputs.iter().map(|topic| topic.look_back()).collect();
        let no_slot = inputs.iter().map(|topic| topic.counts().no_slot).sum();
        self.messages.send(&WorkerMessage::Woken(WakeMessage {
            at_ns,
            run_ns,
            model_ns: self.session.models().run_ns(),
            call,
            triggers,
            looked,
            no_slot,
        }));
        outcome
    }

    fn discard(&mut self) {
        self.guest.discard();
    }

    fn engine(&self) -> LambdaEngine {
        self.guest.engine()
    }
}
