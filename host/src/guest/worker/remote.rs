//! The side of the process that started a worker: a guest whose outcomes come from there.

use std::ffi::OsString;
use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_journal::Said;
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_lambda::signals::{Curve, Signals};
use gleaner_lambda::{Fault, FaultKind};
use gleaner_protocol::{Layer, UNTIL_KILLED};

use super::process::{Ended, NoMessage, Process};
use super::{Called, Done, Message, Woken};
use crate::api::Session;
use crate::api::data::{Counts, Topic, Wake};
use crate::api::log::{LINE_BYTES, Level, cut};
use crate::api::trace::offered;
use crate::guest::{Guest, Outcome, Totals};

/// A guest in a worker.
pub struct Remote {
    /// None once it has ended.
    worker: Option<Process>,
    /// Why it has ended, if it should not have.
    fault: Option<Fault>,
    session: Session,
    engine: String,
    layers: Vec<Layer>,
    /// The next message, if it was read ahead of its turn.
    read: Option<Read>,
    /// Samples that should have woken the lambda, and did not in the worker.
    left_out: u64,
    /// Most log lines of one call: the worker sends no more than its rate limit lets pass.
    lines_max: u64,
    is_prepared: bool,
    resident_bytes: u64,
    most_resident_bytes: u64,
}

/// The message that ends a call, and what the lambda logged in it.
struct Read {
    log: Vec<(Level, String)>,
    message: Message,
}

impl Remote {
    /// Starts a worker with `arguments` and those of this process, in the control group of this
    /// process if there is one, and waits until it is sandboxed.
    ///
    /// # Errors
    ///
    /// [`NotReady`] if the worker cannot be started, or ends before it is ready.
    pub fn start(
        arguments: Vec<OsString>,
        manifest: &Manifest,
        session: Session,
        group: Option<Layer>,
    ) -> Result<Self, NotReady> {
        let mut worker = Process::start(arguments).map_err(NotReady::Failed)?;
        let (engine, mut layers) = match worker.next() {
            Ok(Message::Ready { engine, layers }) => (engine, layers),
            _ => return Err(not_ready(worker, manifest)),
        };
        worker.ready();
        if let Some(group) = group {
            layers.retain(|layer| layer.name != group.name);
            layers.push(group);
        }
        let Limits { log_lines, .. } = manifest.limits;
        Ok(Self {
            worker: Some(worker),
            fault: None,
            session,
            engine,
            layers,
            read: None,
            left_out: 0,
            lines_max: log_lines,
            is_prepared: false,
            resident_bytes: 0,
            most_resident_bytes: 0,
        })
    }

    /// Reads the next message that ends a call, and the log lines before it, unless that was done.
    fn read(&mut self) -> Result<&Read, Fault> {
        let read = match self.read.take() {
            Some(read) => read,
            None => self.read_on()?,
        };
        Ok(self.read.insert(read))
    }

    fn read_on(&mut self) -> Result<Read, Fault> {
        let mut log = Vec::new();
        loop {
            let Some(worker) = &mut self.worker else { return Err(self.killed(None)) };
            match worker.next() {
                Ok(Message::Log { level, message }) => {
                    if log.len() as u64 >= self.lines_max || message.len() > LINE_BYTES {
                        return Err(self.killed(Some("more log than its limits allow")));
                    }
                    log.push((level, message));
                }
                Ok(message) => return Ok(Read { log, message }),
                Err(NoMessage::Ended) => return Err(self.killed(None)),
                Err(NoMessage::Malformed(why)) => return Err(self.killed(Some(&why))),
            }
        }
    }

    /// Takes over the call that ends with the next message, which `wanted` accepts.
    fn call<T>(&mut self, wanted: impl Fn(Message) -> Option<T>) -> Result<T, Fault> {
        self.read()?;
        let Some(Read { log, message }) = self.read.take() else { return Err(self.killed(None)) };
        log.iter().for_each(|(level, message)| self.session.write(*level, message));
        wanted(message).ok_or_else(|| self.killed(Some("a message that is not due")))
    }

    /// Takes over what a call counted; returns how the call ended.
    fn called(&mut self, called: Called) -> Result<(), Fault> {
        let Called { fault, said: (lines, digest), log_dropped, triggers_refused, resident_bytes } =
            called;
        let lines = u32::try_from(lines).unwrap_or(u32::MAX);
        self.session.relay_counts(Said { lines, digest }, log_dropped, triggers_refused);
        self.resident_bytes = self.resident_bytes.max(resident_bytes);
        fault.map_or(Ok(()), |fault| {
            Err(Fault { message: cut(&fault.message, LINE_BYTES).to_owned(), ..fault })
        })
    }

    fn woken(&mut self, wake: &Wake) -> Result<Woken, Fault> {
        let woken = self.call(|message| match message {
            Message::Woken(woken) => Some(woken),
            _ => None,
        })?;
        if woken.at_ns != wake.at_ns() {
            return Err(self.killed(Some("a wake of another time")));
        }
        Ok(woken)
    }

    /// Returns the fault of a worker that has ended; one that sent `nonsense` is ended for it.
    fn killed(&mut self, nonsense: Option<&str>) -> Fault {
        if let Some(fault) = &self.fault {
            return fault.clone();
        }
        let patience = if nonsense.is_some() { Duration::ZERO } else { UNTIL_KILLED };
        let record = self.end(patience).and_then(|ended| ended.record);
        let killed = record.as_ref().and_then(|record| record.killed);
        let how = match (nonsense, record) {
            (Some(what), _) => format!("reported {what}, and was ended for it"),
            (None, Some(record)) => {
                record.sentence().unwrap_or_else(|| "ended by itself, with exit code 0".to_owned())
            }
            (None, None) => "has ended".to_owned(),
        };
        let message = format!("the lambda's process {how}");
        let (used, allowed) =
            (killed.map(|killed| killed.ran_ns), killed.map(|killed| killed.allowed_ns));
        self.fault.insert(Fault { kind: FaultKind::Killed, message, used, allowed }).clone()
    }

    fn end(&mut self, patience: Duration) -> Option<Ended> {
        let ended = self.worker.take()?.end(patience);
        let ended = ended
            .map_err(|error| tracing::warn!(%error, "the lambda's process cannot be waited for"))
            .ok()?;
        self.most_resident_bytes = ended.record.as_ref().map_or(0, |record| record.max_rss_bytes);
        Some(ended)
    }

    /// Waits for the end of a worker that has sent everything.
    fn ended_well(&mut self) -> Result<(), Fault> {
        let Some(ended) = self.end(UNTIL_KILLED) else { return Ok(()) };
        if ended.was_forced {
            tracing::warn!("the lambda's process did not end after its last wake, and was ended");
            return Ok(());
        }
        if ended.code == Some(0) {
            return Ok(());
        }
        let how = ended
            .record
            .and_then(|record| record.sentence())
            .unwrap_or_else(|| "did not end in order".to_owned());
        let message = format!("the lambda's process {how}, after its last wake");
        Err(Fault { kind: FaultKind::Killed, message, used: None, allowed: None })
    }
}

/// Returns whether a lambda over `inputs` can have read this.
fn is_possible(curve: &Curve, inputs: &[Arc<Topic>]) -> bool {
    let points = curve.at_ns.len();
    points <= Signals::POINTS_MAX
        && [curve.min.len(), curve.max.len()] == [points; 2]
        && curve.path.len() <= LINE_BYTES
        && inputs
            .iter()
            .any(|topic| topic.name() == curve.input && topic.ros_topic() == curve.topic)
}

/// Why there is no worker.
pub enum NotReady {
    /// It has printed why, and this is how it ended.
    Explained(Exit),
    /// It has not.
    Failed(Failure),
}

/// Returns the failure of a worker that ended before any code of the lambda ran: its exit code is
/// that of our own programs.
fn not_ready(worker: Process, manifest: &Manifest) -> NotReady {
    let message = format!("cannot start lambda `{}`", manifest.lambda.name);
    NotReady::Failed(match worker.end(UNTIL_KILLED) {
        Ok(Ended { record, code, is_explained, .. }) => {
            let exit = code.and_then(Exit::from_code).filter(|exit| *exit != Exit::Ok);
            if let Some(exit) = exit.filter(|_| is_explained) {
                return NotReady::Explained(exit);
            }
            let mut failure = Failure::new(exit.unwrap_or(Exit::Internal), message);
            let how =
                record.and_then(|record| record.sentence()).unwrap_or_else(|| "ended".to_owned());
            failure.causes = vec![format!("its process {how}, before the lambda was loaded")];
            failure
        }
        Err(error) => Failure::caused_by(Exit::Internal, message, &error),
    })
}

impl Guest for Remote {
    fn prepare(&mut self) -> Result<(), Fault> {
        self.is_prepared = true;
        let called = self.call(|message| match message {
            Message::Prepared(called) => Some(called),
            _ => None,
        })?;
        self.called(called)
    }

    fn init(&mut self) -> Result<(), Fault> {
        if !self.is_prepared {
            self.prepare()?;
        }
        let called = self.call(|message| match message {
            Message::Initialised(called) => Some(called),
            _ => None,
        })?;
        self.called(called)
    }

    fn wake(&mut self, wake: Wake) -> Outcome {
        let Woken { run_ns, call, triggers, looked, .. } = match self.woken(&wake) {
            Ok(woken) => woken,
            Err(fault) => return Outcome { result: Err(fault), fuel: None, run_ns: None },
        };
        for trigger in triggers {
            if let Err(error) = self.session.relay_trigger(trigger) {
                let fault = self.killed(Some(&format!("a trigger that cannot be: {error}")));
                return Outcome { result: Err(fault), fuel: None, run_ns: None };
            }
        }
        for (topic, back) in self.session.inputs().iter().zip(looked) {
            back.into_iter().for_each(|back| topic.relay_looked(back));
        }
        Outcome { result: self.called(call), fuel: None, run_ns: Some(run_ns) }
    }

    fn expects(&mut self, wake: &Wake) -> bool {
        // Where the lambda holds all cells of a ring, that of the worker refuses a sample, and the
        // next wake is later.
        let no_slot = match (wake, self.read().map(|read| &read.message)) {
            (Wake::Event(_), Ok(Message::Woken(woken))) if woken.at_ns > wake.at_ns() => {
                woken.no_slot
            }
            (Wake::Event(_), Ok(Message::Done(done))) => done.no_slot(),
            _ => 0,
        };
        let offered = self
            .session
            .inputs()
            .iter()
            .fold(0_u64, |sum, topic| sum.saturating_add(offered(topic)));
        let is_left_out = self.left_out < no_slot.min(offered);
        self.left_out += u64::from(is_left_out);
        !is_left_out
    }

    fn engine(&self) -> String {
        self.engine.clone()
    }

    fn layers(&self) -> Result<Vec<Layer>, Failure> {
        Ok(self.layers.clone())
    }

    fn resident_bytes(&self) -> u64 {
        self.resident_bytes
    }

    fn most_resident_bytes(&self) -> u64 {
        self.most_resident_bytes
    }

    fn finish(&mut self) -> Result<Option<Totals>, Fault> {
        let done = self.call(|message| match message {
            Message::Done(done) => Some(done),
            _ => None,
        })?;
        let no_slot = done.no_slot();
        let Done { counts, decode_ns, curves: n, curves_omitted } = done;
        if n > Signals::CURVES_MAX {
            return Err(self.killed(Some("more curves than there can be")));
        }
        let curves = (0..n).map(|_| {
            self.call(|message| match message {
                Message::Curve(curve) => Some(curve),
                _ => None,
            })
        });
        let curves = curves.collect::<Result<Vec<_>, _>>()?;
        let inputs = self.session.inputs();
        if !curves.iter().all(|curve| is_possible(curve, &inputs)) {
            return Err(self.killed(Some("a curve that cannot be")));
        }
        let is_counted = |(topic, counts): (&Arc<Topic>, &Counts)| {
            let parts = [counts.received, counts.no_slot, counts.too_big];
            parts.into_iter().try_fold(0, u64::checked_add) == Some(offered(topic))
                && counts.skipped <= offered(topic)
        };
        if counts.len() != inputs.len()
            || !inputs.iter().zip(&counts).all(is_counted)
            || self.left_out > no_slot
        {
            return Err(self.killed(Some("counts of samples that cannot be")));
        }
        self.ended_well()?;
        Ok(Some(Totals { counts, decode_ns, curves, curves_omitted }))
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        self.end(Duration::ZERO);
    }
}
