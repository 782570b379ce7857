//! One lambda of a run: its process, and its counts over all restarts.
//!
//! - `state`: its state, with what belongs to it; each event below is one function here.
//! - `process`: one process, and how it has ended. `restarts`: what follows.

mod process;
mod restarts;
mod state;

use std::path::Path;
use std::process::ExitStatus;
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::FaultKind;
use gleaner_protocol::supervision::{LambdaPhase, LambdaStatus};
use gleaner_protocol::{Handover, LiveStatus, Report};

use crate::failures::Failures;
use crate::observer::{RestartedPart, RunObserver};
use crate::output::ChildOutput;
use crate::process::ChildProcess;
use crate::revision_check::{CheckFailure, RevisionCheck};
use crate::spec::LambdaSpec;
use crate::summary::{EarlierCounts, RunCounts};
use process::{EndCause, LambdaProcess, ProcessEnd, ProcessFailure, Readiness, WorstFault};
use restarts::RestartPolicy;
use state::LambdaState;

/// Statuses of a lambda after the end of a drive, until one of them counts every sample: the first
/// may have been on its way already.
const STATUSES_AFTER_DRIVE: u32 = 2;

pub(crate) struct SupervisedLambda {
    pub(crate) lambda: LambdaSpec,
    state: LambdaState,
    /// Time since which it has this state, or is ready.
    since: Instant,
    /// Number of earlier processes.
    pub(crate) restarts: u32,
    policy: RestartPolicy,
    /// The reason of the last end of its process that was not requested.
    last_end: Option<String>,
    /// Set once the observer was warned of its faults.
    has_warned_of_faults: bool,
    /// Set while it is known to have no recorder.
    is_unrecorded: bool,
    earlier: EarlierCounts,
}

impl SupervisedLambda {
    pub(crate) fn new(lambda: LambdaSpec) -> Self {
        Self {
            policy: RestartPolicy::of(lambda.is_kept()),
            lambda,
            state: LambdaState::Due(Instant::now()),
            since: Instant::now(),
            restarts: 0,
            last_end: None,
            has_warned_of_faults: false,
            is_unrecorded: false,
            earlier: EarlierCounts::default(),
        }
    }

    /// Returns whether its process is to be started now. The files of a deployed lambda are checked
    /// before, in a thread.
    pub(crate) fn is_due(
        &mut self,
        bell: &SyncSender<ChildOutput>,
        observer: &mut dyn RunObserver,
    ) -> bool {
        match &self.state {
            LambdaState::Checked(_) => return true,
            LambdaState::Due(at) if Instant::now() >= *at => match &self.lambda.deployment {
                None => return true,
                Some(deployment) => {
                    let check = RevisionCheck::start(deployment, bell.clone());
                    self.enter(LambdaState::Checking(check));
                }
            },
            LambdaState::Checking(check) => match check.result() {
                None => {}
                Some(Ok(prepared)) => {
                    if let Some(made) = prepared.as_ref().and_then(|it| it.made.as_ref()) {
                        self.warn(observer, &format!("made its Python environment: {made}"));
                    }
                    self.state = LambdaState::Checked(prepared.map(|it| it.python));
                    return true;
                }
                Some(Err(CheckFailure { reason, is_shortage: true })) => {
                    self.failed_to_start(reason, observer);
                }
                Some(Err(CheckFailure { reason, .. })) => self.quarantine(reason),
            },
            _ => {}
        }
        false
    }

    /// Returns the interpreter of its environment, as checked for the start that is due.
    pub(crate) fn python(&self) -> Option<&Path> {
        let LambdaState::Checked(python) = &self.state else { return None };
        python.as_deref()
    }

    /// Enters a state at this time; one that is to end for good keeps its state.
    fn enter(&mut self, state: LambdaState) {
        if !self.is_leaving() {
            self.state = state;
        }
        self.since = Instant::now();
    }

    fn quarantine(&mut self, reason: String) {
        self.last_end = Some(reason.clone());
        self.enter(LambdaState::Quarantined(Some(reason)));
    }

    /// Returns the reason of a quarantine, once.
    pub(crate) fn take_quarantine(&mut self) -> Option<String> {
        let LambdaState::Quarantined(reason) = &mut self.state else { return None };
        reason.take()
    }

    /// Notes that its process could not be created, by no fault of its own.
    pub(crate) fn failed_to_start(&mut self, reason: String, observer: &mut dyn RunObserver) {
        let (cause, ran) = (EndCause::Shortage, Duration::ZERO);
        let failure = ProcessFailure { reason, has_faulted: false, cause, ran, ready_for: None };
        self.has_failed(failure, observer);
    }

    /// Ends it for good. It has left when [`has_left`](Self::has_left) returns true.
    pub(crate) fn leave(&mut self) {
        if !self.is_leaving() {
            self.terminate();
            let process = self.state.take_process();
            self.enter(LambdaState::Stopping(process));
        }
    }

    /// Returns whether it is to end for good.
    pub(crate) fn is_leaving(&self) -> bool {
        matches!(self.state, LambdaState::Stopping(_))
    }

    pub(crate) fn has_left(&self) -> bool {
        matches!(self.state, LambdaState::Stopping(None))
    }

    pub(crate) fn process_number(&self) -> Option<u32> {
        self.state.process().map(|process| process.number)
    }

    /// Keeps the last error message that its process writes to standard error.
    pub(crate) fn has_written(&mut self, text: &[u8]) {
        if let Some(process) = self.state.process_mut() {
            process.error.add(text, &self.lambda.prefix);
        }
    }

    /// Returns whether it waits for nothing: its process is ready, or it could not start.
    pub(crate) fn is_settled(&self) -> bool {
        self.state.process().map_or(!self.will_start(), LambdaProcess::is_ready)
    }

    /// Returns whether a process is to be started for it, at once or later.
    pub(crate) fn will_start(&self) -> bool {
        use LambdaState::{Checked, Checking, Due};
        matches!(self.state, Due(_) | Checking(_) | Checked(_))
    }

    /// Returns the time until it is to be started; `None` if it is not, or waits for its check.
    pub(crate) fn due_in(&self) -> Option<Duration> {
        let LambdaState::Due(at) = self.state else { return None };
        Some(at.saturating_duration_since(Instant::now()))
    }

    pub(crate) fn has_not_started(&self) -> bool {
        matches!(self.state, LambdaState::NotStarted)
    }

    pub(crate) fn started(&mut self, child: ChildProcess, number: u32) {
        self.enter(LambdaState::Running(Box::new(LambdaProcess::new(child, number))));
    }

    pub(crate) fn status(&mut self) -> Result<Option<ExitStatus>, Failure> {
        self.state.process_mut().map_or(Ok(None), |process| process.child.status())
    }

    pub(crate) fn is_running(&self) -> bool {
        self.state.process().is_some()
    }

    /// Returns the number of pipes of its process that are open; `None` without a process.
    pub(crate) fn open_pipes(&self) -> Option<u8> {
        self.state.process().map(|process| process.open_pipes)
    }

    pub(crate) fn closed(&mut self) {
        if let Some(process) = self.state.process_mut() {
            process.open_pipes = process.open_pipes.saturating_sub(1);
        }
    }

    /// Notes that the ingress has ended: a process that was not ready may end as well, and is
    /// started again.
    pub(crate) fn lost_service(&mut self) {
        if let Some(process) = self.state.process_mut()
            && !process.is_ready()
        {
            process.readiness = Readiness::WithoutService;
        }
    }

    pub(crate) fn pass(&self, connections: &Handover, observer: &mut dyn RunObserver) {
        let process = self.state.process();
        if let Some(warning) = process.and_then(|process| process.child.pass(connections)) {
            self.warn(observer, &warning);
        }
    }

    pub(crate) fn terminate(&mut self) {
        if let Some(process) = self.state.process_mut() {
            process.child.terminate();
        }
    }

    pub(crate) fn kill_if_late(&mut self, observer: &mut dyn RunObserver) {
        let process = self.state.process_mut();
        if let Some(warning) = process.and_then(|process| process.child.kill_if_late()) {
            self.warn(observer, &warning);
        }
    }

    fn warn(&self, observer: &mut dyn RunObserver, text: &str) {
        observer.warn(&format!("{}{text}", self.lambda.prefix));
    }

    /// Shows a report of its process. `drive_ended` is true after the end of the drive.
    pub(crate) fn show(
        &mut self,
        report: Report,
        drive_ended: bool,
        observer: &mut dyn RunObserver,
    ) {
        let Some(process) = self.state.process_mut() else { return };
        observer.lambda(&self.lambda, &report);
        match report {
            Report::Ready => {
                self.since = Instant::now();
                process.readiness = Readiness::Ready(self.since);
                self.policy.became_ready();
            }
            Report::Isolation { layers } => process.layers = layers,
            Report::Decision(decision) => {
                process.note_fault(match decision.fault.as_ref().map(|fault| fault.kind) {
                    None => WorstFault::None,
                    Some(FaultKind::Killed) => WorstFault::LostWake,
                    Some(_) => WorstFault::Counted,
                });
            }
            Report::Live(live) => {
                process.after_drive += u32::from(drive_ended);
                self.earlier.observe(&live);
                process.note_counts(live);
                self.warn_of_status(observer);
            }
            Report::Ended(live) => {
                process.has_ended = true;
                process.note_counts(live);
            }
            _ => {}
        }
    }

    /// Warns once that a deployed lambda is faulty, and once for each time without a recorder.
    fn warn_of_status(&mut self, observer: &mut dyn RunObserver) {
        let Some(status) = self.status_report() else { return };
        let [faults, unrecorded] = status.warnings();
        let is_new = [!self.has_warned_of_faults, !self.is_unrecorded];
        self.has_warned_of_faults |= faults.is_some();
        self.is_unrecorded = unrecorded.is_some();
        for (text, is_new) in [faults, unrecorded].into_iter().zip(is_new) {
            if let Some(text) = text.filter(|_| is_new) {
                self.warn(observer, &text);
            }
        }
    }

    /// Returns whether its process, if it is ready, has handled all samples of a drive that is
    /// over.
    pub(crate) fn has_handled_drive(&self) -> bool {
        let Some(process) = self.state.process() else { return true };
        let event = self.lambda.manifest.event_input().map(|input| input.name.as_str());
        let has_handled = |live: &LiveStatus| {
            let topic = live.topics.iter().find(|topic| Some(&*topic.name) == event);
            topic.is_none_or(|topic| live.wakes + live.backed_off + topic.skipped >= topic.received)
        };
        !process.is_ready()
            || (process.after_drive >= STATUSES_AFTER_DRIVE
                && process.last.as_deref().is_some_and(has_handled))
    }

    pub(crate) fn phase(&self) -> LambdaPhase {
        self.state.phase()
    }

    /// Returns its status; `None` for one that was not deployed.
    pub(crate) fn status_report(&self) -> Option<LambdaStatus> {
        let deployment = self.lambda.deployment.as_ref()?;
        let process = self.state.process();
        let last = process.and_then(|process| process.last.as_deref());
        Some(LambdaStatus {
            id: deployment.id.clone(),
            name: deployment.name.clone(),
            revision: deployment.revision.clone(),
            attempt: deployment.attempt,
            phase: self.phase(),
            phase_s: self.since.elapsed().as_secs_f64(),
            pid: process.map(|process| process.child.pid()),
            restarts: self.restarts,
            last_end: self.last_end.clone(),
            live: self.earlier.with(last).map(Box::new),
            recent: self.earlier.recent.get(),
            layers: process.map(|process| process.layers.clone()).unwrap_or_default(),
        })
    }

    pub(crate) fn wakes(&self) -> u64 {
        let last = self.state.process().and_then(|process| process.last.as_ref());
        last.map_or(0, |live| live.wakes)
    }

    /// Handles the end of its process with `status`. It is started again after a delay, unless the
    /// run `is_ending`.
    pub(crate) fn ended(
        &mut self,
        status: ExitStatus,
        is_ending: bool,
        observer: &mut dyn RunObserver,
        failures: &mut Failures,
    ) {
        let is_ending = is_ending || self.is_leaving();
        let is_lost = |process: &LambdaProcess| process.readiness == Readiness::WithoutService;
        if !is_ending && self.state.process().is_some_and(is_lost) {
            return self.interrupted(observer, failures);
        }
        let Some(process) = self.state.take_process() else { return };
        observer.lambda_gone(&self.lambda);
        let failure = match process.classify(&self.lambda, status, is_ending) {
            ProcessEnd::Complete(exit) => {
                return self.enter(LambdaState::Ended(exit, process.last));
            }
            // It has printed the cause. After a successful start it is restarted, since the cause
            // may be temporary.
            ProcessEnd::NotStarted(exit, _) if self.policy.starts_once() => {
                failures.add_not_started(exit);
                self.enter(LambdaState::NotStarted);
                if !self.lambda.prefix.is_empty() {
                    self.warn(observer, "it could not start; the other lambdas run on");
                }
                return;
            }
            ProcessEnd::NotStarted(_, failure) | ProcessEnd::Failed(failure) => failure,
        };
        self.add_earlier(*process);
        failures.add(format!("{}{}", self.lambda.prefix, failure.reason), failure.has_faulted);
        match is_ending {
            true => self.warn(observer, &failure.reason),
            false => self.has_failed(failure, observer),
        }
    }

    /// Handles the end of its process, which was requested as another process of the run failed.
    pub(crate) fn interrupted(&mut self, observer: &mut dyn RunObserver, failures: &mut Failures) {
        let Some(process) = self.state.take_process() else { return };
        failures.note(process.worst > WorstFault::None);
        observer.lambda_gone(&self.lambda);
        self.add_earlier(*process);
        self.restart_in(Duration::ZERO);
    }

    /// Lets it be started again after a delay, unless it fails too often.
    fn has_failed(&mut self, failure: ProcessFailure, observer: &mut dyn RunObserver) {
        match self.policy.after(&failure) {
            Err(reason) => self.quarantine(reason),
            Ok(delay) => {
                self.restart_in(delay);
                let shown = format!("{}{}", self.lambda.prefix, failure.reason);
                self.last_end = Some(failure.reason);
                let part = RestartedPart::Lambda(&self.lambda);
                observer.restarts(part, &shown, delay, self.restarts);
            }
        }
    }

    fn restart_in(&mut self, delay: Duration) {
        self.restarts += 1;
        self.enter(LambdaState::Due(Instant::now() + delay));
    }

    fn add_earlier(&mut self, process: LambdaProcess) {
        let has_lost_wake = process.worst == WorstFault::LostWake;
        self.earlier.add(process.last.map(|last| *last), has_lost_wake);
    }

    /// Returns the exit code of the process that ended on request.
    pub(crate) fn exit(&self) -> Exit {
        if let LambdaState::Ended(exit, _) = self.state { exit } else { Exit::Ok }
    }

    /// Completes its `summary.json` after the end of the run, unless it could not start.
    pub(crate) fn complete(self, counts: &RunCounts) -> Result<(), Failure> {
        let last = match self.state {
            LambdaState::NotStarted => return Ok(()),
            LambdaState::Ended(_, last) => last,
            _ => None,
        };
        self.earlier.complete(last.map(|last| *last), counts, &self.lambda.out)
    }
}

#[cfg(test)]
mod tests;
