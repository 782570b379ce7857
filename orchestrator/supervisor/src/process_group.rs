//! Starts and supervises the processes of a run: an ingress, a recorder, and one for each lambda.
//!
//! A process that fails is started again, while the others run on: those that run receive a
//! connection to the next ingress or recorder. In a run that plays a drive, the end of one of these
//! two is the end of the run.

use std::collections::HashSet;
use std::process::ExitStatus;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::Failure;
use gleaner_lambda::{BuildDir, Vehicle};
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::AddTopics;

use crate::drive::DriveProgress;
use crate::failures::Failures;
use crate::group_end::GroupEnd;
use crate::inference::{InferenceService, InferenceUse};
use crate::ingress::IngressProcess;
use crate::observer::{RestartedPart, RunObserver};
use crate::output::{ChildId, ChildOutput, OutputPiece};
use crate::process::{ChildProcess, ended};
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

pub(crate) struct ProcessGroup<'a> {
    pub(crate) context: &'a RunContext<'a>,
    pub(crate) lambdas: &'a mut Vec<SupervisedLambda>,
    pub(crate) observer: &'a mut dyn RunObserver,
    pub(crate) failures: &'a mut Failures,
    counts: &'a mut RunCounts,
    pub(crate) ingress: IngressProcess,
    /// The largest sample of an input, in bytes.
    largest: u64,
    pub(crate) recorder: Option<RecorderProcess>,
    pub(crate) sender: SyncSender<ChildOutput>,
    pub(crate) output: Receiver<ChildOutput>,
    pub(crate) vehicle: Vehicle,
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
            let is_late = self.ingress.restarts.start > 0 && time.is_over_before_ready();
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
        if let Some(end) = self.ended_service()? {
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
                if !supervised.is_kept() {
                    return Err(failure);
                }
                supervised.failed_to_start(&failure, self.observer);
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
            ("gleaner-runtime", ChildId::Lambda { process: number }, &lambda.prefix),
            arguments::runtime(context.spec, lambda, context.offset_ns, restarts),
            Some((arguments::shim(context.spec, lambda, restarts), supervised.python.as_deref())),
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
            if !looks_at_all && !self.lambdas[index].has_closed_a_pipe() {
                continue;
            }
            if let Some(status) = self.lambdas[index].status()? {
                self.drain(|group| group.lambdas[index].has_output());
                ended.push((index, status));
            }
        }
        Ok(ended)
    }

    /// Returns the end of the group if the ingress or the recorder has ended, and all others must
    /// end with it.
    fn ended_service(&mut self) -> Result<Option<GroupEnd>, Failure> {
        if let Some(end) = self.ended_ingress()? {
            return Ok(Some(end));
        }
        self.ended_recorder()
    }

    /// Starts the ingress again if it has ended, or receives nothing more; returns the end of the
    /// group if all others must end with it.
    fn ended_ingress(&mut self) -> Result<Option<GroupEnd>, Failure> {
        let Self { ingress, context, observer, .. } = self;
        if ingress.restarts.has_ended() {
            if ingress.restarts.is_due() {
                match ingress.start_again(context, self.largest, &self.sender) {
                    Ok(last) => self.counts.add(last, None),
                    Err(failure) => {
                        let (reason, delay) = ingress.restarts.not_started(&failure);
                        let starts = ingress.restarts.start + 1;
                        observer.restarts(RestartedPart::Ingress, &reason, delay, starts);
                    }
                }
            }
            return Ok(None);
        }
        let plays_drive = !context.spec.drives.is_empty();
        let Some(status) = ingress.child.status()? else {
            ingress.kill_if_broken(plays_drive);
            return Ok(None);
        };
        let is_ready = ingress.restarts.is_ready;
        let is_first = ingress.restarts.start == 0 && !is_ready && !context.spec.is_vehicle();
        if plays_drive || is_first {
            return Ok(Some(GroupEnd::of("the ingress", status, !is_ready)));
        }
        self.drain(|group| group.ingress.open_pipes > 0);
        let Self { ingress, observer, .. } = self;
        ingress.leave_network();
        let reason = ingress.end_reason(status);
        observer.ingress_gone();
        let (delay, starts) = (ingress.restarts.ended(status), ingress.restarts.start + 1);
        observer.restarts(RestartedPart::Ingress, &reason, delay, starts);
        self.failures.add(reason, false);
        self.lambdas.iter_mut().for_each(SupervisedLambda::lost_service);
        Ok(None)
    }

    /// Connects the processes that ran before the current ingress to it. Does nothing more if it
    /// has ended, which the caller notices.
    fn join_ingress(&mut self) {
        let Self { context, lambdas, observer, ingress, recorder, .. } = self;
        if std::mem::replace(&mut ingress.is_joined, true) {
            return;
        }
        if let Some(recorder) = recorder.as_mut().filter(|it| it.restarts.is_running()) {
            let start = recorder.restarts.start;
            let reader = grants::recorder(context.spec, start);
            let added = ingress.control.add_reader(&grants::again(reader, true));
            let Some(socket) = ingress.granted(added) else { return };
            let mut again = HashSet::new();
            for supervised in lambdas.iter() {
                let topics = recorder.topics.take_again(&supervised.lambda, &mut again);
                if !topics.is_empty() {
                    let reader = grants::recorder_name(start);
                    let add = AddTopics { reader, topics };
                    let added = ingress.control.add_topics(&add);
                    if ingress.granted(added).is_none() {
                        return;
                    }
                }
            }
            let passed = Handover { ingress: Some(socket), ..Handover::default() };
            if let Some(warning) = recorder.child().and_then(|child| child.pass(&passed)) {
                observer.warn(&warning);
            }
        }
        for supervised in lambdas.iter_mut().filter(|supervised| supervised.is_running()) {
            let lambda = &supervised.lambda;
            let is_recorded = recorder.is_some() && lambda.manifest.record.is_some();
            let number = supervised.process_number();
            let reader = grants::lambda(lambda, context.spec, is_recorded, number);
            let added = ingress.control.add_reader(&grants::again(reader, recorder.is_some()));
            let Some(socket) = ingress.granted(added) else { return };
            let passed = Handover { ingress: Some(socket), ..Handover::default() };
            supervised.pass(&passed, *observer);
        }
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
                let reason = ended("the recorder", status);
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
            let reason = self.ingress.end_reason(status);
            self.observer.warn(&reason);
            self.failures.add(reason, false);
        }
        self.drain(|group| {
            let recorder = group.recorder.as_ref().map_or(0, |recorder| recorder.open_pipes);
            group.ingress.open_pipes > 0 || recorder > 0
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
