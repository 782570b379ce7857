//! The events of a run, as the status and as records of the spool `events`.

use std::collections::BTreeSet;
use std::io::Write;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Builder;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, format_duration, in_one_line};
use gleaner_lambda::Clip;
use gleaner_protocol::Report;
use gleaner_protocol::inference::InferenceReport;
use gleaner_protocol::ingress::{IngressReport, IngressStatus};
use gleaner_protocol::link::{Loss, RecorderReport};
use gleaner_protocol::process_stats::usage;
use gleaner_protocol::supervision::{
    EventKind, ProcessStatus, SupervisionSpec, SupervisorStatus, VehicleEvent,
};

use crate::event_log::EventLog;
use crate::inference::InferenceEvent;
use crate::observer::{RestartedPart, RunObserver};
use crate::spec::LambdaSpec;

/// Number of pieces of standard error that wait for their reader.
const STDERR_QUEUE: usize = 256;

/// The board. A clone shows the same.
#[derive(Clone)]
pub(super) struct StatusBoard {
    log: Arc<EventLog>,
    status: Arc<Mutex<SupervisorStatus>>,
    started: Instant,
    /// To the thread that writes to standard error, whose reader may be stuck.
    lines: SyncSender<Vec<u8>>,
}

impl StatusBoard {
    /// Opens the log of events.
    pub(super) fn open(spec: &SupervisionSpec) -> Result<Self, Failure> {
        let log = Arc::new(EventLog::open(&spec.spool, "events")?);
        let (lines, written) = sync_channel::<Vec<u8>>(STDERR_QUEUE);
        let write = move || {
            for line in written {
                // Of an orchestrator that has ended, the terminal may be closed.
                let _ = std::io::stderr().write_all(&line);
            }
        };
        Builder::new()
            .name("stderr".to_owned())
            .spawn(write)
            .map_err(|it| Failure::caused_by(Exit::Internal, "cannot start a thread", &it))?;
        Ok(Self { log, status: Arc::default(), started: Instant::now(), lines })
    }

    /// Adds an event, about a deployed lambda or not.
    pub(super) fn event(&self, event: EventKind, lambda: Option<&LambdaSpec>, text: &str) {
        let deployment = lambda.and_then(|lambda| lambda.deployment.as_ref());
        self.log.add(&VehicleEvent {
            event,
            lambda: deployment.map(|deployment| deployment.id.clone()),
            revision: deployment.map(|deployment| deployment.revision.clone()),
            text: in_one_line(text),
        });
    }

    /// Returns the status, without generation and lambdas.
    pub(super) fn status(&self) -> SupervisorStatus {
        let (up_s, events_lost) = (self.started.elapsed().as_secs_f64(), self.log.lost());
        let (rss_bytes, cpu_s) = (usage::resident(), usage::cpu_seconds());
        SupervisorStatus { up_s, events_lost, rss_bytes, cpu_s, ..self.lock().clone() }
    }

    /// Returns which of ingress, recorder and process of models are ready.
    pub(super) fn ready_services(&self) -> [bool; 3] {
        let status = self.lock();
        let recorder = status.recorder.as_ref().is_some_and(|it| it.is_ready);
        let inference = status.inference.as_ref().is_some_and(|it| it.is_ready);
        [status.ingress.is_ready, recorder, inference]
    }

    /// Returns whether a process that all lambdas share has ended, and the next one is not ready.
    pub(super) fn lacks_service(&self) -> bool {
        fn lacks<S>(service: Option<&ProcessStatus<S>>) -> bool {
            service.is_some_and(|it| it.restarts > 0 && !it.is_ready)
        }
        let status = self.lock();
        lacks(Some(&status.ingress))
            || lacks(status.recorder.as_ref())
            || lacks(status.inference.as_ref())
    }

    /// Notes that all shared processes have ended, for this reason.
    pub(super) fn group_ended(&self, reason: &str) {
        let mut status = self.lock();
        status.ingress.ended(reason);
        status.recorder.iter_mut().for_each(|recorder| recorder.ended(reason));
        status.inference.iter_mut().for_each(|inference| inference.ended(reason));
    }

    fn lock(&self) -> MutexGuard<'_, SupervisorStatus> {
        self.status.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn clip(&self, clip: &Clip, what: &str) {
        let (file, bytes) = (clip.file.display(), clip.bytes);
        let mut status = self.lock();
        status.clips += 1;
        // A lambda that was started again in the clip is in it twice.
        let names: BTreeSet<&str> = clip.lambdas.iter().map(|it| it.name.as_str()).collect();
        for name in names {
            let counts = status.clips_by_lambda.entry(name.to_owned()).or_default();
            counts.clips += 1;
            counts.bytes += bytes;
        }
        drop(status);
        self.event(EventKind::Clip, None, &format!("{what} clip {file} of {bytes} bytes"));
    }
}

impl RunObserver for StatusBoard {
    fn lambda(&mut self, lambda: &LambdaSpec, report: &Report) {
        if matches!(report, Report::Ready) {
            self.event(EventKind::Ready, Some(lambda), "ready");
        }
    }

    fn lambda_gone(&mut self, _: &LambdaSpec) {}

    fn quarantined(&mut self, lambda: &LambdaSpec, reason: &str) {
        self.event(EventKind::Quarantined, Some(lambda), reason);
    }

    fn ingress(&mut self, report: &IngressReport) {
        let ingress = &mut self.lock().ingress;
        match report {
            IngressReport::Ready => ingress.is_ready = true,
            IngressReport::Status(status) => ingress.last = Some(status.clone()),
            _ => {}
        }
    }

    fn ingress_gone(&mut self) {
        self.lock().ingress.is_ready = false;
    }

    fn ingress_ended(&mut self, status: &IngressStatus) {
        self.lock().ingress.last = Some(Box::new(status.clone()));
    }

    fn recorder(&mut self, report: &RecorderReport) {
        match report {
            RecorderReport::Ready => {
                self.lock().recorder.get_or_insert_default().is_ready = true;
            }
            RecorderReport::Status(status) | RecorderReport::Ended(status) => {
                self.lock().recorder.get_or_insert_default().last = Some(status.clone());
            }
            RecorderReport::Clip(clip) => self.clip(clip, "recorded"),
            RecorderReport::Recovered(clip) => self.clip(clip, "recovered"),
            RecorderReport::Loss(loss) => self.event(EventKind::Loss, None, &loss_text(loss)),
        }
    }

    fn inference(&mut self, event: InferenceEvent) {
        match event {
            InferenceEvent::Report(report) => {
                let mut status = self.lock();
                let inference = status.inference.get_or_insert_default();
                match report {
                    InferenceReport::Ready => inference.is_ready = true,
                    InferenceReport::Status(last) | InferenceReport::Ended(last) => {
                        inference.last = Some(Box::new(last));
                    }
                    _ => {}
                }
            }
            InferenceEvent::Stderr(piece) => self.stderr(&piece),
            InferenceEvent::Ended(reason, delay, _) => {
                self.lock().inference.get_or_insert_default().ended(&reason);
                self.event(EventKind::Failed, None, &failed(&reason, delay));
            }
            InferenceEvent::Refused(text) => {
                self.warn(&text);
                let refused = &mut self.lock().refused_models;
                if !refused.contains(&text) {
                    refused.push(text);
                }
            }
            InferenceEvent::Warning(text) => self.warn(&text),
        }
    }

    fn playing(&mut self, files: &str) {
        self.event(EventKind::Started, None, &format!("playing {files}"));
    }

    fn restarts(&mut self, part: RestartedPart<'_>, reason: &str, delay: Duration, _restarts: u32) {
        let lambda = match part {
            RestartedPart::All | RestartedPart::Ingress => {
                self.lock().ingress.ended(reason);
                None
            }
            RestartedPart::Recorder => {
                self.lock().recorder.get_or_insert_default().ended(reason);
                None
            }
            RestartedPart::Lambda(lambda) => Some(lambda),
        };
        // The event has the id.
        let reason = lambda.and_then(|it| reason.strip_prefix(&it.prefix)).unwrap_or(reason);
        // A process that was replaced has not failed.
        match delay.is_zero() {
            true => self.event(EventKind::Started, lambda, reason),
            false => self.event(EventKind::Failed, lambda, &failed(reason, delay)),
        }
    }

    fn warn(&mut self, text: &str) {
        self.event(EventKind::Warning, None, text);
    }

    fn stderr(&mut self, piece: &[u8]) {
        // What does not fit is dropped: the spools have all that counts.
        let _ = self.lines.try_send(piece.to_vec());
    }
}

fn failed(reason: &str, delay: Duration) -> String {
    let delay = Duration::from_millis(u64::try_from(delay.as_millis()).unwrap_or(u64::MAX));
    format!("{reason}; it starts again in {}", format_duration(delay))
}

fn loss_text(loss: &Loss) -> String {
    match loss {
        Loss::Deleted { file, bytes, reason, .. } => {
            format!("clip {} of {bytes} bytes was deleted: {reason}", file.display())
        }
        Loss::NotDeleted { file, reason, .. } => {
            format!("clip {} could not be deleted: {reason}", file.display())
        }
        Loss::Failed { reason, .. } => format!("a clip could not be written: {reason}"),
        Loss::DiskSuppressed { triggers, reason, .. } => {
            format!("{triggers} triggers recorded nothing: {reason}")
        }
    }
}
