//! The parent's side: a guest whose outcomes are read from a worker.

use std::ffi::OsString;
use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_journal::LogDigest;
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_lambda::signals::{Curve, Signals};
use gleaner_lambda::{Fault, FaultKind};
use gleaner_protocol::{Layer, SHUTDOWN_TIMEOUT};

use super::process::{NoMessage, WorkerExit, WorkerProcess};
use super::{CallOutcome, TotalsMessage, WakeMessage, WorkerMessage};
use crate::api::Session;
use crate::api::data::{Counts, Topic, Wake};
use crate::api::log::{LINE_BYTES, Level, cut};
use crate::api::trace::offered;
use crate::guest::{Guest, LambdaEngine, Totals, WakeOutcome};

pub struct RemoteGuest {
    /// `None` once it has ended.
    worker: Option<WorkerProcess>,
    /// The fault with which it ended early.
    fault: Option<Fault>,
    session: Session,
    engine: LambdaEngine,
    layers: Vec<Layer>,
    /// The next message, if it was read ahead.
    read: Option<CallMessages>,
    /// Number of wakes that did not happen in the worker, since its ring refused their samples.
    skipped_wakes: u64,
    /// Maximum number of log lines of one call: the rate limit of the worker.
    lines_max: u64,
    is_prepared: bool,
    resident_bytes: u64,
    peak_resident_bytes: u64,
}

/// The message that ends a call, and the log lines of the call.
struct CallMessages {
    log: Vec<(Level, String)>,
    message: WorkerMessage,
}

impl RemoteGuest {
    /// Starts a worker with `arguments` and those of this process, in the control group of this
    /// process if there is one, and waits until it is sandboxed.
    ///
    /// # Errors
    ///
    /// [`WorkerStartError`] if the worker cannot be started, or ends before it is ready.
    pub fn start(
        arguments: Vec<OsString>,
        manifest: &Manifest,
        session: Session,
        group: Option<Layer>,
    ) -> Result<Self, WorkerStartError> {
        let mut worker = WorkerProcess::start(arguments).map_err(WorkerStartError::Failed)?;
        let (engine, mut layers) = match worker.next() {
            Ok(WorkerMessage::Ready { engine, layers }) => (engine, layers),
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
            skipped_wakes: 0,
            lines_max: log_lines,
            is_prepared: false,
            resident_bytes: 0,
            peak_resident_bytes: 0,
        })
    }

    /// Reads the next message that ends a call, and the log lines before it, unless it was read
    /// ahead.
    fn read(&mut self) -> Result<&CallMessages, Fault> {
        let read = match self.read.take() {
            Some(read) => read,
            None => self.read_on()?,
        };
        Ok(self.read.insert(read))
    }

    fn read_on(&mut self) -> Result<CallMessages, Fault> {
        let mut log = Vec::new();
        loop {
            let Some(worker) = &mut self.worker else { return Err(self.killed(None)) };
            match worker.next() {
                Ok(WorkerMessage::Log { level, message }) => {
                    if log.len() as u64 >= self.lines_max || message.len() > LINE_BYTES {
                        return Err(self.killed(Some("more log lines than its limits allow")));
                    }
                    log.push((level, message));
                }
                Ok(message) => return Ok(CallMessages { log, message }),
                Err(NoMessage::Ended) => return Err(self.killed(None)),
                Err(NoMessage::Malformed(why)) => return Err(self.killed(Some(&why))),
            }
        }
    }

    /// Takes over the call that ends with the next message, which `wanted` accepts.
    fn call<T>(&mut self, wanted: impl Fn(WorkerMessage) -> Option<T>) -> Result<T, Fault> {
        self.read()?;
        let Some(CallMessages { log, message }) = self.read.take() else {
            return Err(self.killed(None));
        };
        log.iter().for_each(|(level, message)| self.session.write(*level, message));
        wanted(message).ok_or_else(|| self.killed(Some("an unexpected message")))
    }

    /// Takes over the counts of a call; returns its fault, if any.
    fn called(&mut self, called: CallOutcome) -> Result<(), Fault> {
        let CallOutcome {
            fault,
            said: (lines, digest),
            log_dropped,
            triggers_refused,
            resident_bytes,
        } = called;
        let lines = u32::try_from(lines).unwrap_or(u32::MAX);
        self.session.relay_counts(LogDigest { lines, digest }, log_dropped, triggers_refused);
        self.resident_bytes = self.resident_bytes.max(resident_bytes);
        fault.map_or(Ok(()), |fault| {
            Err(Fault { message: cut(&fault.message, LINE_BYTES).to_owned(), ..fault })
        })
    }

    fn woken(&mut self, wake: &Wake) -> Result<WakeMessage, Fault> {
        let woken = self.call(|message| match message {
            WorkerMessage::Woken(woken) => Some(woken),
            _ => None,
        })?;
        if woken.at_ns != wake.at_ns() {
            return Err(self.killed(Some("a wake at another time")));
        }
        Ok(woken)
    }

    /// Returns the fault of a worker that has ended, or kills one that sent a `malformed` message.
    fn killed(&mut self, malformed: Option<&str>) -> Fault {
        if let Some(fault) = &self.fault {
            return fault.clone();
        }
        let timeout = if malformed.is_some() { Duration::ZERO } else { SHUTDOWN_TIMEOUT };
        let record = self.end(timeout).and_then(|ended| ended.record);
        let killed = record.as_ref().and_then(|record| record.killed);
        let how = match (malformed, record) {
            (Some(what), _) => format!("sent {what}, and was killed"),
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

    fn end(&mut self, timeout: Duration) -> Option<WorkerExit> {
        let ended = self.worker.take()?.end(timeout);
        let ended = ended
            .map_err(|error| tracing::warn!(%error, "cannot wait for the lambda's process"))
            .ok()?;
        self.peak_resident_bytes = ended.record.as_ref().map_or(0, |record| record.max_rss_bytes);
        Some(ended)
    }

    /// Waits for the end of a worker that has sent everything.
    fn check_exit(&mut self) -> Result<(), Fault> {
        let Some(ended) = self.end(SHUTDOWN_TIMEOUT) else { return Ok(()) };
        if ended.was_forced {
            tracing::warn!("the lambda's process did not end after its last wake, and was killed");
            return Ok(());
        }
        if ended.code == Some(0) {
            return Ok(());
        }
        let how = ended
            .record
            .and_then(|record| record.sentence())
            .unwrap_or_else(|| "ended abnormally".to_owned());
        let message = format!("the lambda's process {how}, after its last wake");
        Err(Fault { kind: FaultKind::Killed, message, used: None, allowed: None })
    }
}

/// Returns whether a lambda over `inputs` can have produced this curve.
fn is_possible(curve: &Curve, inputs: &[Arc<Topic>]) -> bool {
    let points = curve.at_ns.len();
    points <= Signals::POINTS_MAX
        && [curve.min.len(), curve.max.len()] == [points; 2]
        && curve.path.len() <= LINE_BYTES
        && inputs
            .iter()
            .any(|topic| topic.name() == curve.input && topic.ros_topic() == curve.topic)
}

pub enum WorkerStartError {
    /// It has printed the error, and ended with this exit.
    Explained(Exit),
    /// It has printed nothing.
    Failed(Failure),
}

/// Returns the failure of a worker that ended before any code of the lambda ran: its exit code is
/// one of Gleaner's own.
fn not_ready(worker: WorkerProcess, manifest: &Manifest) -> WorkerStartError {
    let message = format!("cannot start lambda `{}`", manifest.lambda.name);
    WorkerStartError::Failed(match worker.end(SHUTDOWN_TIMEOUT) {
        Ok(WorkerExit { record, code, is_explained, .. }) => {
            let exit = code.and_then(Exit::from_code).filter(|exit| *exit != Exit::Ok);
            if let Some(exit) = exit.filter(|_| is_explained) {
                return WorkerStartError::Explained(exit);
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

impl Guest for RemoteGuest {
    fn prepare(&mut self) -> Result<(), Fault> {
        self.is_prepared = true;
        let called = self.call(|message| match message {
            WorkerMessage::Prepared(called) => Some(called),
            _ => None,
        })?;
        self.called(called)
    }

    fn init(&mut self) -> Result<(), Fault> {
        if !self.is_prepared {
            self.prepare()?;
        }
        let called = self.call(|message| match message {
            WorkerMessage::Initialised(called) => Some(called),
            _ => None,
        })?;
        self.called(called)
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        let WakeMessage { run_ns, model_ns, call, triggers, looked, .. } = match self.woken(&wake) {
            Ok(woken) => woken,
            Err(fault) => return WakeOutcome::faulted(fault),
        };
        for trigger in triggers {
            if let Err(error) = self.session.relay_trigger(trigger) {
                let fault = self.killed(Some(&format!("an invalid trigger: {error}")));
                return WakeOutcome::faulted(fault);
            }
        }
        for (topic, back) in self.session.inputs().iter().zip(looked) {
            back.into_iter().for_each(|back| topic.relay_look_back(back));
        }
        WakeOutcome {
            result: self.called(call),
            fuel: None,
            run_ns: Some(run_ns),
            model_ns: Some(model_ns),
        }
    }

    fn expects(&mut self, wake: &Wake) -> bool {
        // If the lambda holds all slots of a ring, the worker's ring refuses a sample, and the next
        // wake is a later one.
        let no_slot = match (wake, self.read().map(|read| &read.message)) {
            (Wake::Event(_), Ok(WorkerMessage::Woken(woken))) if woken.at_ns > wake.at_ns() => {
                woken.no_slot
            }
            (Wake::Event(_), Ok(WorkerMessage::Done(done))) => done.no_slot(),
            _ => 0,
        };
        let offered = self
            .session
            .inputs()
            .iter()
            .fold(0_u64, |sum, topic| sum.saturating_add(offered(topic)));
        let is_skipped = self.skipped_wakes < no_slot.min(offered);
        self.skipped_wakes += u64::from(is_skipped);
        !is_skipped
    }

    fn engine(&self) -> LambdaEngine {
        self.engine.clone()
    }

    fn layers(&self) -> Result<Vec<Layer>, Failure> {
        Ok(self.layers.clone())
    }

    fn resident_bytes(&self) -> u64 {
        self.resident_bytes
    }

    fn peak_resident_bytes(&self) -> u64 {
        self.peak_resident_bytes
    }

    fn finish(&mut self) -> Result<Option<Totals>, Fault> {
        let done = self.call(|message| match message {
            WorkerMessage::Done(done) => Some(done),
            _ => None,
        })?;
        let no_slot = done.no_slot();
        let TotalsMessage { counts, decode_ns, curves: n, curves_omitted } = done;
        if n > Signals::CURVES_MAX {
            return Err(self.killed(Some("too many curves")));
        }
        let curves = (0..n).map(|_| {
            self.call(|message| match message {
                WorkerMessage::Curve(curve) => Some(curve),
                _ => None,
            })
        });
        let curves = curves.collect::<Result<Vec<_>, _>>()?;
        let inputs = self.session.inputs();
        if !curves.iter().all(|curve| is_possible(curve, &inputs)) {
            return Err(self.killed(Some("an invalid curve")));
        }
        let is_counted = |(topic, counts): (&Arc<Topic>, &Counts)| {
            let parts = [counts.received, counts.no_slot, counts.too_big];
            parts.into_iter().try_fold(0, u64::checked_add) == Some(offered(topic))
                && counts.skipped <= offered(topic)
        };
        if counts.len() != inputs.len()
            || !inputs.iter().zip(&counts).all(is_counted)
            || self.skipped_wakes > no_slot
        {
            return Err(self.killed(Some("invalid counts of samples")));
        }
        self.check_exit()?;
        Ok(Some(Totals { counts, decode_ns, curves, curves_omitted }))
    }
}

impl Drop for RemoteGuest {
    fn drop(&mut self) {
        self.end(Duration::ZERO);
    }
}
