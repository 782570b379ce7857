//! One lambda of a run: its process, and its counts over all restarts.

use std::path::PathBuf;
use std::process::ExitStatus;
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::FaultKind;
use gleaner_protocol::supervision::{LambdaPhase, LambdaStatus};
use gleaner_protocol::{Handover, LiveStatus, Report};

use crate::crash_loop::CrashLoop;
use crate::failures::Failures;
use crate::lambda_process::{LambdaProcess, ProcessEnd};
use crate::lambda_state::LambdaState;
use crate::observer::{RestartedPart, RunObserver};
use crate::output::{ChildOutput, PIPES};
use crate::process::ChildProcess;
use crate::restart_delay::{RestartDelay, jittered};
use crate::revision_check::{CheckFailure, RevisionCheck};
use crate::spec::LambdaSpec;
use crate::summary::{EarlierCounts, RunCounts};

/// Statuses of a lambda after the end of a drive, until one of them counts every sample: the first
/// may have been on its way already.
const STATUSES_AFTER_DRIVE: u32 = 2;

pub(crate) struct SupervisedLambda {
    pub(crate) lambda: LambdaSpec,
    /// The interpreter of the environment that was made of its wheels, as checked.
    pub(crate) python: Option<PathBuf>,
    state: LambdaState,
    /// Time since which it has this state.
    since: Instant,
    /// Number of earlier processes.
    pub(crate) restarts: u32,
    /// Set once one of its processes was ready.
    was_ready: bool,
    /// Set when it is to end for good.
    pub(crate) is_leaving: bool,
    crashes: CrashLoop,
    /// Set until its quarantine was reported.
    has_news: bool,
    /// The reason of the last end of its process that was not requested.
    last_end: Option<String>,
    /// Set once the observer was warned of its faults.
    has_warned_of_faults: bool,
    /// Set while it is known to have no recorder.
    is_unrecorded: bool,
    delay: RestartDelay,
    /// Delay after kills by other programs.
    kills: RestartDelay,
    earlier: EarlierCounts,
    /// Exit code of the process that ended on request.
    pub(crate) exit: Exit,
}

impl SupervisedLambda {
    pub(crate) fn new(lambda: LambdaSpec) -> Self {
        Self {
            lambda,
            python: None,
            state: LambdaState::Due(Instant::now()),
            since: Instant::now(),
            restarts: 0,
            was_ready: false,
            is_leaving: false,
            crashes: CrashLoop::default(),
            has_news: false,
            last_end: None,
            has_warned_of_faults: false,
            is_unrecorded: false,
            delay: RestartDelay::new(),
            kills: RestartDelay::of_killed(),
            earlier: EarlierCounts::default(),
            exit: Exit::Ok,
        }
    }

    /// Returns whether its process is to be started now. The files of a deployed lambda are checked
    /// before, in a thread.
    pub(crate) fn is_due(
        &mut self,
        bell: &SyncSender<ChildOutput>,
        observer: &mut dyn RunObserver,
    ) -> bool {
        match &mut self.state {
            _ if self.is_leaving => false,
            LambdaState::Checked => true,
            LambdaState::Due(at) if Instant::now() < *at => false,
            LambdaState::Due(_) => match &self.lambda.deployment {
                None => true,
                Some(deployment) => {
                    let check = RevisionCheck::start(deployment, bell.clone());
                    self.enter(LambdaState::Checking(check));
                    false
                }
            },
            LambdaState::Checking(check) => match check.result() {
                None => false,
                Some(Ok(prepared)) => {
                    if let Some(made) = prepared.as_ref().and_then(|it| it.made.as_ref()) {
                        let (prefix, text) = (&self.lambda.prefix, "made its Python environment");
                        observer.warn(&format!("{prefix}{text}: {made}"));
                    }
                    self.python = prepared.map(|it| it.python);
                    self.state = LambdaState::Checked;
                    true
                }
                Some(Err(CheckFailure { reason, is_shortage: true })) => {
                    self.failed_to_start(&Failure::new(Exit::Internal, reason), observer);
                    false
                }
                Some(Err(CheckFailure { reason, .. })) => {
                    self.quarantine(reason);
                    false
                }
            },
            _ => false,
        }
    }

    /// Returns whether it is started again after every end, unless it fails too often.
    pub(crate) fn is_kept(&self) -> bool {
        self.lambda.deployment.is_some()
    }

    fn enter(&mut self, state: LambdaState) {
        (self.state, self.since) = (state, Instant::now());
    }

    fn quarantine(&mut self, reason: String) {
        self.has_news = true;
        self.last_end = Some(reason);
        self.enter(LambdaState::Quarantined);
    }

    /// Returns the reason of a quarantine, once.
    pub(crate) fn take_quarantine(&mut self) -> Option<String> {
        std::mem::take(&mut self.has_news).then(|| self.last_end.clone().unwrap_or_default())
    }

    /// Notes that its process could not be created, by no fault of its own.
    pub(crate) fn failed_to_start(&mut self, failure: &Failure, observer: &mut dyn RunObserver) {
        let reason = format!("{}{}", self.lambda.prefix, failure.message);
        let delay = jittered(self.delay.after(Duration::ZERO));
        self.restart_in(delay);
        self.last_end = Some(failure.message.clone());
        observer.restarts(RestartedPart::Lambda(&self.lambda), &reason, delay, self.restarts);
    }

    /// Ends it for good. It has left when [`has_left`](Self::has_left) returns true.
    pub(crate) fn leave(&mut self) {
        if !std::mem::replace(&mut self.is_leaving, true) {
            self.since = Instant::now();
            self.terminate();
        }
    }

    /// Returns whether it is to end, and has no process any more.
    pub(crate) fn has_left(&self) -> bool {
        self.is_leaving && !self.is_running()
    }

    /// Returns whether this is its current process.
    pub(crate) fn runs_as(&self, number: u32) -> bool {
        matches!(&self.state, LambdaState::Running(process) if process.number == number)
    }

    /// Returns the number of its current process in the group; 0 without one.
    pub(crate) fn process_number(&self) -> u32 {
        match &self.state {
            LambdaState::Running(process) => process.number,
            _ => 0,
        }
    }

    /// Keeps the last error message that its process writes to standard error.
    pub(crate) fn has_written(&mut self, text: &[u8]) {
        let prefix = self.lambda.prefix.clone();
        if let Some(process) = self.process() {
            process.error.add(text, &prefix);
        }
    }

    /// Returns whether it waits for nothing: its process is ready, or it could not start.
    pub(crate) fn is_settled(&self) -> bool {
        match &self.state {
            LambdaState::Running(process) => process.is_ready,
            state => !state.will_start(),
        }
    }

    /// Returns whether a process is to be started for it, at once or later.
    pub(crate) fn will_start(&self) -> bool {
        !self.is_leaving && self.state.will_start()
    }

    /// Returns the time until it is to be started; `None` if it is not, or waits for its check.
    pub(crate) fn due_in(&self) -> Option<Duration> {
        self.state.due_in().filter(|_| !self.is_leaving)
    }

    /// Returns whether it could not start, and is not started again.
    pub(crate) fn has_not_started(&self) -> bool {
        matches!(self.state, LambdaState::NotStarted)
    }

    pub(crate) fn started(&mut self, child: ChildProcess, number: u32) {
        self.enter(LambdaState::Running(Box::new(LambdaProcess::new(child, number))));
    }

    fn process(&mut self) -> Option<&mut LambdaProcess> {
        match &mut self.state {
            LambdaState::Running(process) => Some(process),
            _ => None,
        }
    }

    /// Returns the exit status of its process if that has ended.
    pub(crate) fn status(&mut self) -> Result<Option<ExitStatus>, Failure> {
        self.process().map_or(Ok(None), |process| process.child.status())
    }

    pub(crate) fn is_running(&self) -> bool {
        matches!(self.state, LambdaState::Running(_))
    }

    pub(crate) fn has_closed_a_pipe(&mut self) -> bool {
        self.process().is_some_and(|process| process.open_pipes < PIPES)
    }

    /// Returns whether a pipe of its process is open.
    pub(crate) fn has_output(&mut self) -> bool {
        self.process().is_some_and(|process| process.open_pipes > 0)
    }

    /// Notes that a pipe of its process is closed.
    pub(crate) fn closed(&mut self) {
        if let Some(process) = self.process() {
            process.open_pipes = process.open_pipes.saturating_sub(1);
        }
    }

    /// Notes that the ingress has ended: a process that was not ready may end as well, and is
    /// started again.
    pub(crate) fn lost_service(&mut self) {
        if let Some(process) = self.process() {
            process.has_lost_service |= !process.is_ready;
        }
    }

    /// Passes its process connections to processes that were started again.
    pub(crate) fn pass(&mut self, connections: &Handover, observer: &mut dyn RunObserver) {
        let prefix = self.lambda.prefix.clone();
        if let Some(warning) = self.process().and_then(|it| it.child.pass(connections)) {
            observer.warn(&format!("{prefix}{warning}"));
        }
    }

    pub(crate) fn terminate(&mut self) {
        if let Some(process) = self.process() {
            process.child.terminate();
        }
    }

    /// Kills the process if it does not end on request.
    pub(crate) fn kill_if_late(&mut self, observer: &mut dyn RunObserver) {
        let prefix = self.lambda.prefix.clone();
        if let Some(warning) = self.process().and_then(|process| process.child.kill_if_late()) {
            observer.warn(&format!("{prefix}{warning}"));
        }
    }

    /// Shows a report of its process. `drive_ended` is true after the end of the drive.
    pub(crate) fn show(
        &mut self,
        report: Report,
        drive_ended: bool,
        observer: &mut dyn RunObserver,
    ) {
        let Self { lambda, state, was_ready, since, earlier, .. } = self;
        let LambdaState::Running(process) = state else { return };
        observer.lambda(lambda, &report);
        match report {
            Report::Ready => {
                process.is_ready = true;
                (*was_ready, *since) = (true, Instant::now());
            }
            Report::Isolation { layers } => process.layers = layers,
            Report::Decision(decision) => {
                let fault = decision.fault.as_ref().map(|fault| fault.kind);
                process.has_faulted |= fault.is_some();
                process.has_lost_wake |= fault == Some(FaultKind::Killed);
            }
            Report::Live(live) => {
                process.has_faulted |= live.faults > 0;
                process.after_drive += u32::from(drive_ended);
                earlier.observe(&live);
                process.last = Some(live);
                self.warn(observer);
            }
            Report::Ended(live) => {
                process.has_ended = true;
                process.has_faulted |= live.faults > 0;
                process.last = Some(live);
            }
            _ => {}
        }
    }

    /// Warns once that a deployed lambda is faulty, and once for each time without a recorder.
    fn warn(&mut self, observer: &mut dyn RunObserver) {
        let Some(status) = self.status_report() else { return };
        let [faults, unrecorded] = status.warnings();
        let is_new = [!self.has_warned_of_faults, !self.is_unrecorded];
        self.has_warned_of_faults |= faults.is_some();
        self.is_unrecorded = unrecorded.is_some();
        for (text, is_new) in [faults, unrecorded].into_iter().zip(is_new) {
            if let Some(text) = text.filter(|_| is_new) {
                observer.warn(&format!("{}{text}", self.lambda.prefix));
            }
        }
    }

    /// Returns whether its process, if it is ready, has handled all samples of a drive that is
    /// over.
    pub(crate) fn has_handled_drive(&self) -> bool {
        let LambdaState::Running(process) = &self.state else { return true };
        let event = self.lambda.manifest.event_input().map(|input| input.name.as_str());
        let has_handled = |live: &LiveStatus| {
            let topic = live.topics.iter().find(|topic| Some(&*topic.name) == event);
            topic.is_none_or(|topic| live.wakes + live.backed_off + topic.skipped >= topic.received)
        };
        !process.is_ready
            || (process.after_drive >= STATUSES_AFTER_DRIVE
                && process.last.as_deref().is_some_and(has_handled))
    }

    pub(crate) fn phase(&self) -> LambdaPhase {
        if self.is_leaving { LambdaPhase::Stopping } else { self.state.phase() }
    }

    /// Returns its status; `None` for one that was not deployed.
    pub(crate) fn status_report(&self) -> Option<LambdaStatus> {
        let deployment = self.lambda.deployment.as_ref()?;
        let process = match &self.state {
            LambdaState::Running(process) => Some(process),
            _ => None,
        };
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
            recent: self.earlier.recent(),
            layers: process.map(|process| process.layers.clone()).unwrap_or_default(),
        })
    }

    pub(crate) fn wakes(&self) -> u64 {
        let LambdaState::Running(process) = &self.state else { return 0 };
        process.last.as_ref().map_or(0, |live| live.wakes)
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
        let is_lost = |process: &mut LambdaProcess| process.has_lost_service && !process.is_ready;
        let is_ending = is_ending || self.is_leaving;
        if !is_ending && self.process().is_some_and(is_lost) {
            return self.interrupted(observer, failures);
        }
        let Some(process) = self.take_process() else { return };
        observer.lambda_gone(&self.lambda);
        let (prefix, is_kept) = (&self.lambda.prefix, self.is_kept());
        let (mut is_unusable, mut is_blameless) = (false, false);
        let (reason, faulted) = match process.classify(&self.lambda, status, is_ending) {
            ProcessEnd::Complete(exit) if is_ending || !is_kept => {
                self.exit = exit;
                self.enter(LambdaState::Ended(process.last));
                return;
            }
            ProcessEnd::Complete(_) => ("another program has ended its process".to_owned(), false),
            // It has printed the cause. After a successful start it is restarted, since the cause
            // may be temporary.
            ProcessEnd::NotStarted { exit, .. } if !self.was_ready && !is_kept => {
                failures.add_not_started(exit);
                self.state = LambdaState::NotStarted;
                if !prefix.is_empty() {
                    observer.warn(&format!("{prefix}it could not start; the other lambdas run on"));
                }
                return;
            }
            ProcessEnd::NotStarted { exit, blameless } => {
                is_blameless = blameless;
                // A start with the same files and settings fails again.
                is_unusable = is_kept && !blameless && matches!(exit, Exit::Usage | Exit::Denied);
                (process.not_started(is_kept), exit == Exit::LambdaFaulted)
            }
            ProcessEnd::Broken { reason, faulted } => (reason, faulted),
        };
        let (ran, is_ready) = (process.started.elapsed(), process.is_ready);
        let is_outside = is_kept && process.was_killed_from_outside(&self.lambda, status);
        let sender = if is_outside { ", by another program or by the lambda itself" } else { "" };
        let reason = format!("{reason}{sender}");
        let shown = format!("{prefix}{reason}");
        self.add_earlier(*process);
        failures.add(shown.clone(), faulted);
        if is_ending {
            observer.warn(&shown);
            return;
        }
        if is_kept {
            let ready_for = if is_ready { self.since.elapsed() } else { Duration::ZERO };
            let is_loop = match (is_blameless, is_outside) {
                (true, _) => None,
                (false, true) => self.crashes.killed(ready_for),
                (false, false) => self.crashes.ended(Instant::now(), is_ready),
            };
            if is_unusable {
                return self.quarantine(reason);
            }
            if let Some(why) = is_loop {
                return self.quarantine(format!("{why}; the last time, {reason}"));
            }
            self.last_end = Some(reason);
        }
        let delays = if is_outside { &mut self.kills } else { &mut self.delay };
        let delay = delays.after(ran);
        let delay = if is_kept { jittered(delay) } else { delay };
        self.restart_in(delay);
        observer.restarts(RestartedPart::Lambda(&self.lambda), &shown, delay, self.restarts);
    }

    /// Handles the end of its process, which was requested as another process of the run failed.
    pub(crate) fn interrupted(&mut self, observer: &mut dyn RunObserver, failures: &mut Failures) {
        let Some(process) = self.take_process() else { return };
        failures.note(process.has_faulted);
        observer.lambda_gone(&self.lambda);
        self.add_earlier(*process);
        self.restart_in(Duration::ZERO);
    }

    /// Takes the current process. The caller sets the next state.
    fn take_process(&mut self) -> Option<Box<LambdaProcess>> {
        match std::mem::replace(&mut self.state, LambdaState::Ended(None)) {
            LambdaState::Running(process) => Some(process),
            other => {
                self.state = other;
                None
            }
        }
    }

    fn restart_in(&mut self, delay: Duration) {
        self.restarts += 1;
        self.enter(LambdaState::Due(Instant::now() + delay));
    }

    fn add_earlier(&mut self, process: LambdaProcess) {
        self.earlier.add(process.last.map(|last| *last), process.has_lost_wake);
    }

    /// Completes its `summary.json` after the end of the run, unless it could not start.
    pub(crate) fn complete(self, counts: &RunCounts) -> Result<(), Failure> {
        let last = match self.state {
            LambdaState::NotStarted => return Ok(()),
            LambdaState::Ended(last) => last,
            _ => None,
        };
        self.earlier.complete(last.map(|last| *last), counts, &self.lambda.out)
    }
}

#[cfg(test)]
mod tests;
