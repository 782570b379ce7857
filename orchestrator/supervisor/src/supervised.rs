//! One lambda of a run: its process, and its counts over all restarts.

use std::os::fd::OwnedFd;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::FaultKind;
use gleaner_protocol::{ExitRecord, LiveStatus, Report};

use crate::failures::Failures;
use crate::observer::RunObserver;
use crate::output::PIPES;
use crate::process::{ChildProcess, ended};
use crate::restart_delay::RestartDelay;
use crate::spec::LambdaSpec;
use crate::summary::{EarlierCounts, RunCounts};

/// Statuses of a lambda after the end of a drive, until one of them counts every sample: the first
/// may have been on its way already.
const STATUSES_AFTER_DRIVE: u32 = 2;

/// A lambda, with its current process.
pub(crate) struct SupervisedLambda {
    pub(crate) lambda: LambdaSpec,
    state: LambdaState,
    /// Number of earlier processes.
    pub(crate) restarts: u32,
    /// Set once one of its processes was ready.
    was_ready: bool,
    delay: RestartDelay,
    earlier: EarlierCounts,
    /// Exit code of the process that ended on request.
    pub(crate) exit: Exit,
}

enum LambdaState {
    /// To be started at this time.
    Due(Instant),
    Running(Box<LambdaProcess>),
    /// It could not start, and is not started again.
    NotStarted,
    /// It has ended on request, with this last status.
    Ended(Option<Box<LiveStatus>>),
}

/// A process of a lambda.
struct LambdaProcess {
    child: ChildProcess,
    started: Instant,
    open_pipes: u8,
    /// Set when the lambda has finished its `init`.
    is_ready: bool,
    /// Set when the lambda has faulted.
    has_faulted: bool,
    /// Set when the process ended during a wake, which it could not count.
    has_lost_wake: bool,
    /// Set by the last report of the process.
    has_ended: bool,
    /// Set when the ingress ended before the process was ready.
    has_lost_ingress: bool,
    last: Option<Box<LiveStatus>>,
    /// Number of statuses since the end of the drive.
    after_drive: u32,
}

/// The end of a process.
enum ProcessEnd {
    /// On request.
    Complete(Exit),
    /// The lambda could not start; a program has printed the cause.
    NotStarted(Exit),
    Broken {
        reason: String,
        faulted: bool,
    },
}

impl SupervisedLambda {
    pub(crate) fn new(lambda: LambdaSpec) -> Self {
        Self {
            lambda,
            state: LambdaState::Due(Instant::now()),
            restarts: 0,
            was_ready: false,
            delay: RestartDelay::new(),
            earlier: EarlierCounts::default(),
            exit: Exit::Ok,
        }
    }

    /// Returns whether its process is to be started now.
    pub(crate) fn is_due(&self) -> bool {
        matches!(&self.state, LambdaState::Due(at) if Instant::now() >= *at)
    }

    /// Returns whether it waits for nothing: its process is ready, or it could not start.
    pub(crate) fn is_settled(&self) -> bool {
        match &self.state {
            LambdaState::Running(process) => process.is_ready,
            LambdaState::Due(_) => false,
            LambdaState::NotStarted | LambdaState::Ended(_) => true,
        }
    }

    /// Returns whether it could not start, and is not started again.
    pub(crate) fn has_not_started(&self) -> bool {
        matches!(self.state, LambdaState::NotStarted)
    }

    /// Sets the process that was started for it.
    pub(crate) fn started(&mut self, child: ChildProcess) {
        self.state = LambdaState::Running(Box::new(LambdaProcess {
            child,
            started: Instant::now(),
            open_pipes: PIPES,
            is_ready: false,
            has_faulted: false,
            has_lost_wake: false,
            has_ended: false,
            has_lost_ingress: false,
            last: None,
            after_drive: 0,
        }));
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

    /// Notes that the ingress has ended: a process that was not ready ends as well, and is started
    /// again.
    pub(crate) fn lost_ingress(&mut self) {
        if let Some(process) = self.process() {
            process.has_lost_ingress |= !process.is_ready;
        }
    }

    /// Passes its process a connection to another ingress.
    pub(crate) fn pass_ingress(&mut self, ingress: OwnedFd, observer: &mut dyn RunObserver) {
        let prefix = self.lambda.prefix.clone();
        if let Some(warning) = self.process().and_then(|it| it.child.pass_ingress(ingress)) {
            observer.warn(&format!("{prefix}{warning}"));
        }
    }

    /// Requests the process to end.
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
        let Self { lambda, state: LambdaState::Running(process), was_ready, .. } = self else {
            return;
        };
        observer.lambda(lambda, &report);
        match report {
            Report::Ready => {
                process.is_ready = true;
                *was_ready = true;
            }
            Report::Decision(decision) => {
                let fault = decision.fault.as_ref().map(|fault| fault.kind);
                process.has_faulted |= fault.is_some();
                process.has_lost_wake |= fault == Some(FaultKind::Killed);
            }
            Report::Live(live) => {
                process.has_faulted |= live.faults > 0;
                process.after_drive += u32::from(drive_ended);
                process.last = Some(live);
            }
            Report::Ended(live) => {
                process.has_ended = true;
                process.has_faulted |= live.faults > 0;
                process.last = Some(live);
            }
            _ => {}
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

    /// Returns the number of wakes of its process.
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
        let is_lost = |process: &mut LambdaProcess| process.has_lost_ingress && !process.is_ready;
        if !is_ending && self.process().is_some_and(is_lost) {
            return self.interrupted(observer, failures);
        }
        let Some(process) = self.take_process() else { return };
        observer.lambda_gone(&self.lambda);
        let prefix = &self.lambda.prefix;
        let (reason, faulted) = match process.classify(&self.lambda, status, is_ending) {
            ProcessEnd::Complete(exit) => {
                self.exit = exit;
                self.state = LambdaState::Ended(process.last);
                return;
            }
            // It has printed the cause. After a successful start it is restarted, since the cause
            // may be temporary.
            ProcessEnd::NotStarted(exit) if !self.was_ready => {
                failures.add_not_started(exit);
                self.state = LambdaState::NotStarted;
                if !prefix.is_empty() {
                    observer.warn(&format!("{prefix}it could not start; the other lambdas run on"));
                }
                return;
            }
            ProcessEnd::NotStarted(exit) => {
                ("it could not start".to_owned(), exit == Exit::LambdaFaulted)
            }
            ProcessEnd::Broken { reason, faulted } => (reason, faulted),
        };
        let reason = format!("{prefix}{reason}");
        let ran = process.started.elapsed();
        self.add_earlier(*process);
        if is_ending {
            observer.warn(&reason);
        } else {
            let (delay, restarts) = (self.restart_after(ran), self.restarts);
            observer.restarts(&reason, delay, restarts);
        }
        failures.add(reason, faulted);
    }

    /// Handles the end of its process, which was requested as another process of the run failed.
    pub(crate) fn interrupted(&mut self, observer: &mut dyn RunObserver, failures: &mut Failures) {
        let Some(process) = self.take_process() else { return };
        failures.note(process.has_faulted);
        observer.lambda_gone(&self.lambda);
        self.add_earlier(*process);
        self.restarts += 1;
        self.state = LambdaState::Due(Instant::now());
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

    fn restart_after(&mut self, ran: Duration) -> Duration {
        let delay = self.delay.after(ran);
        self.restarts += 1;
        self.state = LambdaState::Due(Instant::now() + delay);
        delay
    }

    fn add_earlier(&mut self, process: LambdaProcess) {
        self.earlier.add(process.last.map(|last| *last), process.has_lost_wake);
    }

    /// Completes its `summary.json` after the end of the run, unless it could not start.
    pub(crate) fn complete(self, counts: &RunCounts) -> Result<(), Failure> {
        let last = match self.state {
            LambdaState::NotStarted => return Ok(()),
            LambdaState::Ended(last) => last,
            LambdaState::Due(_) | LambdaState::Running(_) => None,
        };
        self.earlier.complete(last.map(|last| *last), counts, &self.lambda.out)
    }
}

impl LambdaProcess {
    fn classify(&self, lambda: &LambdaSpec, status: ExitStatus, requested: bool) -> ProcessEnd {
        let record = ExitRecord::read(&lambda.exit_record()).ok();
        // A lambda can end its process as if that had been requested. The shim records whether it
        // was requested, and in time.
        let requested = record.as_ref().map_or(requested, |record| record.end_requested);
        match status.code().and_then(Exit::from_code) {
            // Ended before it could handle the signal.
            None if requested && !self.is_ready => ProcessEnd::Complete(Exit::Ok),
            Some(exit @ (Exit::Ok | Exit::LambdaFaulted)) if requested && self.has_ended => {
                ProcessEnd::Complete(exit)
            }
            Some(exit) if !self.is_ready && exit != Exit::Ok => ProcessEnd::NotStarted(exit),
            _ => {
                let reason = record.as_ref().and_then(ExitRecord::sentence);
                let faulted =
                    self.has_faulted || record.is_some_and(|record| record.is_caused_by_lambda());
                let reason = reason.map_or_else(
                    || ended("the lambda's process", status),
                    |reason| format!("the lambda's process {reason}"),
                );
                ProcessEnd::Broken { reason, faulted }
            }
        }
    }
}
