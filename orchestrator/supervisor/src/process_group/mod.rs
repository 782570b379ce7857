//! Starts and supervises the processes of a run: an ingress, a recorder, and one for each lambda.
//!
//! A process that fails is started again, while the others run on: those that run receive a
//! connection to the next ingress or recorder. In a run that plays a drive, the end of one of these
//! two is the end of the run.
//!
//! - `services`: the ingress and the recorder. `output`: the output of all processes.

mod output;
mod services;

use std::process::ExitStatus;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::{BuildDir, Vehicle};
use gleaner_protocol::Handover;

use crate::drive::DriveProgress;
use crate::failures::Failures;
use crate::inference::{InferenceService, InferenceUse};
use crate::ingress::IngressProcess;
use crate::last_error::unexpected_end;
use crate::observer::RunObserver;
use crate::output::{ChildId, ChildOutput, OutputPiece, PIPES};
use crate::process::ChildProcess;
use crate::recorder::RecorderProcess;
use crate::summary::RunCounts;
use crate::supervised::SupervisedLambda;
use crate::{POLL_INTERVAL, RunContext, RunTime, arguments, grants};

/// Maximum number of queued outputs. Further reports stay in their pipe, and the writer counts
/// those that do not fit.
const QUEUE_LENGTH: usize = 16;

/// The failures and counts of a run, over all of its process groups.
pub(crate) struct RunRecord<'a> {
    pub(crate) failures: &'a mut Failures,
    pub(crate) counts: &'a mut RunCounts,
}

pub(crate) enum GroupEnd {
    /// It ended on request, its time or its drive was over, or no lambda could start.
    Complete,
    /// The ingress or the recorder could not start; it has printed the cause.
    NotStarted(Exit),
    /// The ingress or the recorder failed after the start, for this reason.
    Broken(String),
}

impl GroupEnd {
    /// The end of a process that all others need. `is_first` is true if it was not ready before.
    fn of(name: &str, status: ExitStatus, is_first: bool) -> GroupEnd {
        match status.code().and_then(Exit::from_code) {
            // It has printed the cause.
            Some(exit) if is_first && exit != Exit::Ok => GroupEnd::NotStarted(exit),
            _ => GroupEnd::Broken(unexpected_end(name, status)),
        }
    }
}

pub(crate) struct ProcessGroup<'a> {
    context: &'a RunContext<'a>,
    pub(crate) lambdas: &'a mut Vec<SupervisedLambda>,
    pub(crate) observer: &'a mut dyn RunObserver,
    failures: &'a mut Failures,
    counts: &'a mut RunCounts,
    ingress: IngressProcess,
    /// The largest sample of an input, in bytes.
    largest: u64,
    recorder: Option<RecorderProcess>,
    pub(crate) sender: SyncSender<ChildOutput>,
    output: Receiver<ChildOutput>,
    vehicle: Vehicle,
    /// Number of processes of lambdas so far.
    started: u32,
    /// Time of the last look at the processes of all lambdas.
    looked: Instant,
    /// The process that runs models, if a lambda has any. Dropped after `output`, as its threads
    /// may wait for room there.
    inference: Option<InferenceService>,
}

impl<'a> ProcessGroup<'a> {
    /// Starts the ingress; the others follow when it is ready.
    pub(crate) fn start(
        context: &'a RunContext<'a>,
        lambdas: &'a mut Vec<SupervisedLambda>,
        observer: &'a mut dyn RunObserver,
        RunRecord { failures, counts }: RunRecord<'a>,
        vehicle: &Vehicle,
    ) -> Result<Self, Failure> {
        let (sender, output) = mpsc::sync_channel(QUEUE_LENGTH);
        let largest = largest(lambdas).max(context.spec.largest);
        let ingress = IngressProcess::start(None, context, largest, &sender)?;
        let mut group = Self {
            context,
            lambdas,
            observer,
            failures,
            counts,
            ingress,
            largest,
            recorder: None,
            inference: None,
            sender,
            output,
            vehicle: vehicle.clone(),
            started: 0,
            looked: Instant::now(),
        };
        // On a vehicle, it is started with the first lambda that has any: only that one may wait.
        let has_models =
            |supervised: &SupervisedLambda| !supervised.lambda.manifest.models.is_empty();
        if !context.spec.is_vehicle() && group.lambdas.iter().any(has_models) {
            group.start_inference()?;
        }
        Ok(group)
    }

    /// Starts the process that runs models, unless it runs.
    fn start_inference(&mut self) -> Result<(), Failure> {
        if self.inference.is_none() {
            let sender = self.sender.clone();
            let send = move |event| {
                let piece = OutputPiece::Inference(event);
                drop(sender.send(ChildOutput { from: ChildId::Inference, piece }));
            };
            let (parts, limits) = (&self.context.parts, &self.vehicle.inference);
            self.inference =
                Some(InferenceService::start(parts, limits, InferenceUse::Shared, send)?);
        }
        Ok(())
    }

    /// Runs the processes while `supervise` does, which returns at the end of the run or if a
    /// process failed without which the others cannot go on; then ends them.
    pub(crate) fn run(
        &mut self,
        supervise: impl FnOnce(&mut Self) -> Result<GroupEnd, Failure>,
    ) -> Result<GroupEnd, Failure> {
        let ended = supervise(self);
        self.end_all(matches!(ended, Ok(GroupEnd::Complete)))?;
        ended
    }

    /// Supervises the processes of a run with an end.
    pub(crate) fn supervise(
        &mut self,
        time: &mut RunTime,
        stop: &AtomicBool,
    ) -> Result<GroupEnd, Failure> {
        let mut drive = DriveProgress::of(self.context.spec);
        loop {
            self.poll(POLL_INTERVAL);
            let is_late = self.ingress.restarts.start > 0
                && time.ready.is_none()
                && time.is_over_since_start();
            if stop.load(Ordering::Relaxed) || time.is_over() || is_late {
                return Ok(GroupEnd::Complete);
            }
            if let Some(end) = self.step()? {
                return Ok(end);
            }
            if self.lambdas.iter().all(SupervisedLambda::has_not_started) {
                return Ok(GroupEnd::Complete);
            }
            if self.lambdas.iter().all(SupervisedLambda::is_settled) {
                time.begin();
                if let Some(drive) = &mut drive {
                    drive.begin(&mut self.ingress, self.observer);
                }
            }
            if let Some(drive) = &mut drive
                && self.ingress.drive_ended
                && drive.is_over(self.lambdas, self.observer)
            {
                if let Some(why) = self.ingress.dead() {
                    let kept = "the results up to the damage are kept";
                    self.observer.warn(&format!("the drive is damaged: {why}; {kept}"));
                    self.failures.drive_is_damaged();
                }
                return Ok(GroupEnd::Complete);
            }
        }
    }

    /// Handles the ends of processes, and starts those that are due. Returns the end of the group
    /// if a process failed without which the others cannot go on.
    pub(crate) fn step(&mut self) -> Result<Option<GroupEnd>, Failure> {
        let ended = self.ended_lambdas()?;
        // A lambda may end because one of these did.
        if let Some(end) = self.ended_ingress()? {
            return Ok(Some(end));
        }
        if let Some(end) = self.ended_recorder()? {
            return Ok(Some(end));
        }
        for (index, status) in ended {
            self.lambdas[index].ended(status, false, self.observer, self.failures);
        }
        if self.ingress.restarts.is_ready {
            self.join_ingress();
            self.start_recorder()?;
            self.start_due()?;
        }
        Ok(None)
    }

    /// Adds the counts of ingress and recorder to those of the run.
    pub(crate) fn add_counts(self) {
        let recorder = self.recorder.and_then(|recorder| recorder.last_status());
        self.counts.add(self.ingress.status, recorder);
    }

    fn start_due(&mut self) -> Result<(), Failure> {
        for index in 0..self.lambdas.len() {
            if !self.lambdas[index].is_due(&self.sender, self.observer) {
                continue;
            }
            let lambda = &self.lambdas[index].lambda;
            if let Some(recorder) = &mut self.recorder
                && lambda.manifest.record.is_some()
                && recorder.restarts.is_running()
                && let Err(topic) = recorder.topics.add(lambda)
            {
                let name = lambda.name();
                recorder.replace(format!(
                    "the recorder is started again, as `{name}` needs larger samples of `{topic}`"
                ));
            }
            self.fit_ingress(index);
            if let Err(failure) = self.start_lambda(index) {
                let supervised = &mut self.lambdas[index];
                if !supervised.lambda.is_kept() {
                    return Err(failure);
                }
                supervised.failed_to_start(failure.message, self.observer);
            }
        }
        Ok(())
    }

    /// Starts another ingress if the lambda has larger samples than this one expects.
    fn fit_ingress(&mut self, index: usize) {
        let largest = largest(&self.lambdas[index..=index]);
        if largest > self.largest {
            self.largest = largest;
            let name = self.lambdas[index].lambda.name();
            self.ingress.replace(format!(
                "the ingress is started again, as `{name}` reads samples of {largest} bytes"
            ));
        }
    }

    /// Starts the process of a lambda. Does nothing if the ingress has ended, which the caller
    /// notices.
    fn start_lambda(&mut self, index: usize) -> Result<(), Failure> {
        if !self.lambdas[index].lambda.manifest.models.is_empty() {
            self.start_inference()?;
        }
        let number = self.started;
        let Self { context, ingress, recorder, .. } = self;
        let supervised = &mut self.lambdas[index];
        let (lambda, restarts) = (&supervised.lambda, supervised.restarts);
        let recorder = recorder.as_mut().filter(|_| lambda.manifest.record.is_some());
        let reader = grants::lambda(lambda, context.spec, recorder.is_some(), number);
        let mut connections = Handover::default();
        if let Some(recorder) = recorder {
            let connected = recorder.connect(lambda, self.vehicle.limits, ingress)?;
            let Some(socket) = connected else { return Ok(()) };
            connections.recorder = Some(socket);
        }
        let added = ingress.control.add_reader(&reader);
        let Some(socket) = ingress.granted(added) else { return Ok(()) };
        connections.ingress = Some(socket);
        if let Some(inference) = &self.inference
            && !lambda.manifest.models.is_empty()
        {
            let build = BuildDir::of(&lambda.folder);
            // A lambda of another deployment may have the same name.
            let id = lambda.deployment.as_ref().map_or(lambda.name(), |it| &it.id);
            connections.inference = Some(inference.add(id, &build, &lambda.manifest)?);
        }
        // If its shim is killed, it writes none: that of the process before it would be read.
        let _ = std::fs::remove_file(lambda.exit_record());
        self.started += 1;
        let child = ChildProcess::start(
            &context.parts,
            ("gleaner-runtime", ChildId::Lambda(number), &lambda.prefix),
            arguments::runtime(context.spec, lambda, context.offset_ns, restarts),
            Some((arguments::shim(context.spec, lambda, restarts), supervised.python())),
            connections,
            &self.sender,
        )?;
        supervised.started(child, number);
        Ok(())
    }

    /// Returns the time until a lambda can be started, at most [`POLL_INTERVAL`].
    pub(crate) fn due_in(&self) -> Duration {
        let lambdas = self.lambdas.iter().filter(|_| self.ingress.restarts.is_ready);
        lambdas.filter_map(SupervisedLambda::due_in).fold(POLL_INTERVAL, Duration::min)
    }

    /// Returns the lambdas whose processes have ended, after showing the rest of their output. One
    /// that has ended has closed its pipes; all are looked at from time to time only, as others may
    /// have them open.
    fn ended_lambdas(&mut self) -> Result<Vec<(usize, ExitStatus)>, Failure> {
        let looks_at_all = self.looked.elapsed() >= POLL_INTERVAL;
        if looks_at_all {
            self.looked = Instant::now();
        }
        let mut ended = Vec::new();
        for index in 0..self.lambdas.len() {
            if !looks_at_all && self.lambdas[index].open_pipes().is_none_or(|open| open == PIPES) {
                continue;
            }
            if let Some(status) = self.lambdas[index].status()? {
                self.drain(|group| group.lambdas[index].open_pipes() > Some(0));
                ended.push((index, status));
            }
        }
        Ok(ended)
    }

    /// Ends all processes: those that read before those that they read from, so that nothing is
    /// lost. `is_requested` is false if another process than a lambda's has failed.
    fn end_all(&mut self, is_requested: bool) -> Result<(), Failure> {
        self.lambdas.iter_mut().for_each(SupervisedLambda::terminate);
        while self.lambdas.iter().any(SupervisedLambda::is_running) {
            self.poll(POLL_INTERVAL);
            for (index, status) in self.ended_lambdas()? {
                let lambda = &mut self.lambdas[index];
                if is_requested {
                    lambda.ended(status, true, self.observer, self.failures);
                } else {
                    lambda.interrupted(self.observer, self.failures);
                }
            }
            self.lambdas.iter_mut().for_each(|lambda| lambda.kill_if_late(self.observer));
        }
        let recorder = self.recorder.as_mut();
        if let Some(recorder) = recorder.filter(|recorder| !recorder.restarts.has_ended()) {
            recorder.stop();
            let status = self.wait(|group| group.recorder.as_mut()?.child())?;
            if let Some(status) = status.filter(|status| !status.success()) {
                let reason = unexpected_end("the recorder", status);
                self.observer.warn(&format!(
                    "{reason}: clips may be unfinished, and are recovered by the next run"
                ));
                // Otherwise a failure that counts already has caused the end.
                if is_requested {
                    self.failures.add(reason, false);
                }
            }
        }
        if let Some(inference) = self.inference.take() {
            // Its reader threads wait while the queue of outputs is full.
            let ended = thread::spawn(move || inference.stop());
            while !ended.is_finished() {
                self.poll(POLL_INTERVAL);
            }
        }
        // Fails if it has ended meanwhile.
        let _ = self.ingress.control.stop();
        let status = self.wait(|group| Some(&mut group.ingress.child))?;
        // If it is to be started again, its end is reported already.
        let is_new = !self.ingress.restarts.has_ended();
        let is_failure = |status: &ExitStatus| is_requested && is_new && !status.success();
        if let Some(status) = status.filter(is_failure) {
            let reason = self.ingress.restarts.reason("the ingress", status);
            self.observer.warn(&reason);
            self.failures.add(reason, false);
        }
        self.drain(|group| {
            let recorder = group.recorder.as_ref().map_or(0, |it| it.restarts.open_pipes);
            group.ingress.restarts.open_pipes > 0 || recorder > 0
        });
        self.ingress.leave_network();
        self.ingress.show_last(self.observer);
        Ok(())
    }
}

/// Returns the largest sample of an input, in bytes.
fn largest(lambdas: &[SupervisedLambda]) -> u64 {
    let inputs = lambdas.iter().flat_map(|supervised| &supervised.lambda.manifest.inputs);
    inputs.map(|input| input.max_size.bytes()).max().unwrap_or(0)
}
