//! The loop: owns the lambdas, the sessions and the order of runs. It never waits for a lambda or a
//! model.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_protocol::inference::{
    InferenceReport, InferenceRequest, InferenceServer, InferenceStatus, ModelCall, ModelFaultKind,
    ModelRequest, ModelResult, TensorPlace,
};
use gleaner_protocol::link::Incoming;
use gleaner_protocol::process_stats::{monotonic_ns, usage};
use tracing::{error, info};

use crate::client::{CallStage, ConnectedLambda, LambdaId, OpenCall};
use crate::engine_error::EngineError;
use crate::lambdas::{LambdaTable, ReadyDescriptors, TOO_MANY};
use crate::loader::{LoadDone, LoadJob, PassedModel};
use crate::loads::LoadQueue;
use crate::places::check_inputs;
use crate::schedule::{RunSchedule, WaitingRun};
use crate::sessions::{LoadState, SessionTable};
use crate::threads::{ModelThreads, ThreadResult};
use crate::worker::{LastRun, RunDone, RunJob, RunOutputs, WorkerModel};

const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// Longest time without a status: the starter ends a process that is silent.
const SILENCE: Duration = Duration::from_secs(5);
/// Interval of checks for models that take too long.
const WORK_INTERVAL: Duration = Duration::from_millis(100);
/// Time for a run to end when the process ends.
const END_TIMEOUT: Duration = Duration::from_secs(1);

/// Receives reports. It must not block.
pub type ReportSink = Box<dyn FnMut(InferenceReport) + Send>;

pub(crate) struct InferenceEngine {
    threads: ModelThreads,
    reports: ReportSink,
    lambdas: LambdaTable,
    /// The files of the next lambda.
    files: Vec<PassedModel>,
    sessions: SessionTable,
    loads: LoadQueue,
    schedule: RunSchedule,
    /// Set if the starter tries each load in another process first.
    has_trials: bool,
    /// The next load, and whether its trial is over.
    trial: Option<(LoadJob, bool)>,
    /// Until then, models are loaded and run one at a time.
    apart_until: Instant,
    status_at: Instant,
    reported: Instant,
    status: InferenceStatus,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EngineEnd {
    Stopped,
    StarterEnded,
}

impl InferenceEngine {
    /// Creates the loop. `has_trials` if the starter tries each load in another process first;
    /// for the time `apart`, models are loaded and run one at a time.
    pub(crate) fn new(
        threads: ModelThreads,
        reports: ReportSink,
        has_trials: bool,
        apart: Duration,
    ) -> Self {
        let now = Instant::now();
        Self {
            threads,
            reports,
            lambdas: LambdaTable::default(),
            files: Vec::new(),
            sessions: SessionTable::default(),
            loads: LoadQueue::default(),
            schedule: RunSchedule::default(),
            has_trials,
            trial: None,
            apart_until: now + apart,
            status_at: now + STATUS_INTERVAL,
            reported: now,
            status: InferenceStatus::default(),
        }
    }

    /// Serves lambdas until the starter sends stop or ends, or until `stop` is readable.
    /// After an error, the starter starts the process again.
    pub(crate) fn run(
        mut self,
        mut control: InferenceServer,
        stop: Option<&OwnedFd>,
    ) -> Result<(), EngineError> {
        (self.reports)(InferenceReport::Ready);
        let end = self.serve(&mut control, stop)?;
        info!(reason = ?end, "gleaner-inference is shutting down");
        self.schedule.stop(None);
        self.threads.wait_idle(END_TIMEOUT);
        let status = self.current_status();
        (self.reports)(InferenceReport::Ended(status));
        Ok(())
    }

    fn serve(
        &mut self,
        control: &mut InferenceServer,
        stop: Option<&OwnedFd>,
    ) -> Result<EngineEnd, EngineError> {
        loop {
            let ready = self.wait(control, stop)?;
            if ready.stop {
                return Ok(EngineEnd::Stopped);
            }
            if ready.results {
                self.threads.clear_wake();
                while let Some(result) = self.threads.result() {
                    match result {
                        ThreadResult::Loaded(done) => self.finish_load(done),
                        ThreadResult::Ran(done) => self.finish_run(done),
                    }
                }
            }
            for id in ready.lambdas {
                let request = self.lambdas.get_mut(id).and_then(ConnectedLambda::request);
                if let Some(request) = request {
                    self.handle_request(id, request);
                }
            }
            if ready.control
                && let Some(end) = self.handle_control(control)
            {
                return Ok(end);
            }
            self.remove_gone();
            self.check_deadlines();
            self.start_load();
            self.start_runs();
            self.tick()?;
        }
    }

    fn wait(
        &self,
        control: &InferenceServer,
        stop: Option<&OwnedFd>,
    ) -> Result<ReadyDescriptors, EngineError> {
        let mut timeout = self.status_at.saturating_duration_since(Instant::now());
        if self.threads.are_busy() {
            timeout = timeout.min(WORK_INTERVAL);
        }
        let now_ns = monotonic_ns();
        let changes = [self.lambdas.next_deadline(), self.schedule.changes_at(now_ns)];
        for at in changes.into_iter().flatten() {
            timeout = timeout.min(Duration::from_nanos(at.saturating_sub(now_ns)));
        }
        self.lambdas.wait(control, self.threads.wake(), stop, timeout).map_err(EngineError::Wait)
    }

    fn handle_control(&mut self, control: &mut InferenceServer) -> Option<EngineEnd> {
        loop {
            match control.poll() {
                Ok(Incoming::Message(InferenceRequest::Model(model, file, entry))) => {
                    self.files.push(PassedModel::new(model, file, entry));
                }
                Ok(Incoming::Message(InferenceRequest::Client(add, socket))) => {
                    self.schedule.allow(&add, self.has_trials);
                    self.lambdas.add(add, socket, std::mem::take(&mut self.files));
                }
                Ok(Incoming::Message(InferenceRequest::Tried(load, refused, memory))) => {
                    if let Some((mut job, _)) = self.trial.take_if(|(job, _)| job.key == load) {
                        let session = job.session;
                        job.tried = Some(memory);
                        match refused.or_else(|| self.loads.refusal(memory, &self.sessions)) {
                            Some(why) => {
                                self.finish_load(LoadDone { session, loaded: Err(why) });
                                // Another lambda may open it again.
                                self.sessions.remove(session);
                            }
                            None => self.trial = Some((job, true)),
                        }
                    }
                }
                Ok(Incoming::Message(InferenceRequest::Stop)) => return Some(EngineEnd::Stopped),
                Ok(Incoming::Nothing) => return None,
                Ok(Incoming::Ended) => return Some(EngineEnd::StarterEnded),
                Err(why) => {
                    let error = &why as &dyn std::error::Error;
                    error!(error, "the connection to the parent process failed");
                    return Some(EngineEnd::StarterEnded);
                }
            }
        }
    }

    fn handle_request(&mut self, id: LambdaId, request: ModelRequest) {
        self.expire(id, monotonic_ns());
        // It has given up the call before: its time was over, or it made that call to a process
        // before this one.
        if let Some(before) = self.lambdas.get_mut(id).and_then(|lambda| lambda.call.take()) {
            self.abandon(id, before.stage);
        }
        let is_beyond = self.lambdas.is_beyond(id);
        let Some(lambda) = self.lambdas.get_mut(id) else { return };
        let ModelRequest { id: call, deadline_ns, regions, call: requested } = request;
        if is_beyond {
            return lambda.fail(call, ModelFaultKind::Unavailable, TOO_MANY);
        }
        match requested {
            ModelCall::Reserve { bytes } => lambda.reserve(call, bytes),
            ModelCall::Open { model } => self.open(id, call, deadline_ns, model),
            ModelCall::Run { model, inputs } => {
                self.request_run(id, (call, deadline_ns), model, &inputs, regions);
            }
        }
    }

    fn open(&mut self, id: LambdaId, call: u64, deadline_ns: Option<u64>, model: String) {
        let Some(lambda) = self.lambdas.get_mut(id) else { return };
        let Some(granted) = lambda.granted(&model) else {
            let message = format!("the manifest has no model `{model}`");
            return lambda.fail(call, ModelFaultKind::NoSuchModel, message);
        };
        if let Some(reason) = granted.refused.clone() {
            return lambda.fail(call, ModelFaultKind::Failed, reason);
        }
        let key = granted.key.clone();
        let session = match self.sessions.find(&key) {
            Some(session) => Ok(session),
            None => self.loads.push(key, id, &mut self.lambdas, &mut self.sessions),
        };
        let Some(lambda) = self.lambdas.get_mut(id) else { return };
        let (outputs, stage) = (0, CallStage::Loading);
        match session {
            Ok(session) => {
                let call = OpenCall { id: call, deadline_ns, model, session, outputs, stage };
                lambda.call = Some(call);
            }
            Err(message) => return lambda.fail(call, ModelFaultKind::Failed, message),
        }
        self.answer_open(id);
    }

    /// Starts the next load, if none is in progress: first its trial.
    fn start_load(&mut self) {
        if let Some(job) = self.loads.begin(&self.lambdas, &mut self.sessions) {
            if self.has_trials {
                (self.reports)(InferenceReport::Try(job.key.clone()));
            }
            self.trial = Some((job, !self.has_trials));
        }
        if (!self.is_apart() || self.schedule.is_idle())
            && let Some((job, _)) = self.trial.take_if(|(_, is_over)| *is_over)
        {
            self.threads.load(job);
        }
    }

    fn is_apart(&self) -> bool {
        Instant::now() < self.apart_until
    }

    /// Answers a lambda that opens a model, unless that is still being loaded.
    fn answer_open(&mut self, id: LambdaId) {
        let Some(lambda) = self.lambdas.get_mut(id) else { return };
        let Some(call) = lambda.call.take_if(|call| call.stage == CallStage::Loading) else {
            return;
        };
        match self.sessions.get(call.session).map(|session| &session.state) {
            Some(LoadState::Loading) => lambda.call = Some(call),
            Some(LoadState::Ready(ready)) => {
                lambda.opened.insert(call.model);
                lambda.reply(call.id, Ok(ready.opened()), None, 0);
            }
            Some(LoadState::Failed(reason)) => {
                lambda.fail(call.id, ModelFaultKind::Failed, reason.clone());
                self.sessions.count_failed(call.session);
            }
            None => lambda.fail(call.id, ModelFaultKind::Failed, "the model was removed"),
        }
    }

    fn request_run(
        &mut self,
        id: LambdaId,
        (call, deadline_ns): (u64, Option<u64>),
        model: String,
        inputs: &[TensorPlace],
        [input_region, outputs]: [u64; 2],
    ) {
        let Some(lambda) = self.lambdas.get_mut(id) else { return };
        let Some(granted) = lambda.granted(&model) else {
            let message = format!("the manifest has no model `{model}`");
            return lambda.fail(call, ModelFaultKind::NoSuchModel, message);
        };
        let threads = granted.key.threads.into();
        let session = self.sessions.find(&granted.key).filter(|_| lambda.opened.contains(&model));
        let state = session.and_then(|session| Some((session, self.sessions.get(session)?)));
        let Some((session, LoadState::Ready(ready))) = state.map(|(id, it)| (id, &it.state)) else {
            let message = format!("model `{model}` is not open; open it before its first run");
            return lambda.fail(call, ModelFaultKind::Unavailable, message);
        };
        // Inputs that are in another region would be read from this one.
        let region = lambda.inputs.as_ref().filter(|region| region.id == input_region);
        let region_bytes = region.map_or(0, |region| region.bytes());
        match check_inputs(&ready.inputs, inputs, region_bytes) {
            Ok(placed) => {
                let stage = CallStage::Waiting;
                lambda.call =
                    Some(OpenCall { id: call, deadline_ns, model, session, outputs, stage });
                let (account, inputs) = (lambda.id.clone(), placed);
                let run = WaitingRun { account, session, threads, inputs };
                self.schedule.push(id, deadline_ns, run);
            }
            Err(error) => {
                let message = format!("model `{model}`: {error}");
                lambda.fail(call, ModelFaultKind::WrongInput, message);
                self.sessions.count_failed(session);
            }
        }
    }

    /// Starts the runs that may begin now.
    fn start_runs(&mut self) {
        let is_apart = self.is_apart();
        if is_apart && self.loads.is_busy() && self.trial.is_none() {
            return;
        }
        while let Some((run, inputs)) = self.schedule.begin(is_apart, monotonic_ns()) {
            let (job, stop) = (run.job, Arc::clone(&run.stop));
            let lambda = self.lambdas.get_mut(run.lambda);
            let call = lambda.and_then(|it| Some((it.call.take()?, it)));
            let model = call.as_ref().and_then(|(call, _)| self.threads.model(call.session));
            let (Some((mut call, lambda)), Some(model)) = (call, model) else {
                self.schedule.finish(job, 0, monotonic_ns());
                continue;
            };
            let left =
                call.deadline_ns.map(|at| Duration::from_nanos(at.saturating_sub(monotonic_ns())));
            call.stage = CallStage::Running(job);
            self.threads.run(RunJob {
                job,
                session: call.session,
                model,
                lambda: [lambda.id.clone(), lambda.name.clone()],
                inputs,
                input_region: lambda.inputs.clone(),
                output_region: lambda.outputs.clone(),
                memory: lambda.memory,
                left,
                stop,
            });
            lambda.call = Some(call);
        }
    }

    fn finish_load(&mut self, done: LoadDone) {
        let LoadDone { session: id, loaded } = done;
        self.loads.end();
        let Some(session) = self.sessions.get_mut(id) else { return };
        session.state = match loaded {
            Ok((graph, ready)) => {
                let model = WorkerModel {
                    graph,
                    sha256: session.key.sha256.clone(),
                    path: session.path.clone(),
                    held: ready.memory.held,
                    outputs: ready.outputs.clone(),
                    last: LastRun::default(),
                };
                self.threads.add_model(id, model);
                LoadState::Ready(ready)
            }
            Err(reason) => LoadState::Failed(reason),
        };
        let key = session.key.clone();
        for lambda in self.lambdas.with_call_on(id) {
            self.answer_open(lambda);
        }
        if let Some(report) = self.sessions.report(id, self.lambdas.users(&key)) {
            (self.reports)(InferenceReport::Model(report));
        }
    }

    fn finish_run(&mut self, done: RunDone) {
        let RunDone { job, session, result, ran_ns } = done;
        let ran = ran_ns.unwrap_or(0);
        let Some(run) = self.schedule.finish(job, ran, monotonic_ns()) else { return };
        let waits = |call: &mut OpenCall| call.stage == CallStage::Running(job);
        let lambda = self.lambdas.get_mut(run.lambda);
        let answered = lambda.and_then(|it| Some((it.call.take_if(waits)?, it)));
        if let Some(counts) = self.sessions.get_mut(session).map(|it| &mut it.counts) {
            counts.runs += u64::from(ran_ns.is_some());
            counts.run_ns = counts.run_ns.saturating_add(ran);
            // A call that was answered at its deadline is counted already.
            counts.shared += u64::from(ran_ns.is_none() && result.is_ok());
            counts.failed += u64::from(answered.is_some() && result.is_err());
        }
        let Some((call, lambda)) = answered else { return };
        match result {
            Ok(RunOutputs { places, region, run_ns }) => {
                let ran = ModelResult::Ran { outputs: places, run_ns };
                lambda.reply(call.id, Ok(ran), Some(&region), call.outputs);
                lambda.outputs = Some(region);
            }
            Err(fault) => lambda.reply(call.id, Err(fault), None, 0),
        }
    }

    /// Answers all calls whose deadline has passed.
    fn check_deadlines(&mut self) {
        let now = monotonic_ns();
        for id in self.lambdas.late(now) {
            self.expire(id, now);
        }
    }

    /// Answers the call of a lambda if its deadline has passed.
    fn expire(&mut self, id: LambdaId, now: u64) {
        let is_late =
            |call: &mut OpenCall| call.deadline_ns.is_some_and(|deadline| deadline <= now);
        let Some(lambda) = self.lambdas.get_mut(id) else { return };
        let Some(call) = lambda.call.take_if(is_late) else { return };
        let (kind, state) = match (call.stage, self.loads.other_than(call.session)) {
            (CallStage::Loading, Some(other)) => {
                (ModelFaultKind::Queued, format!("waits for the load of {other}"))
            }
            (CallStage::Loading, None) if self.trial.is_some() => {
                (ModelFaultKind::Queued, "waits for the trial of its load".into())
            }
            (CallStage::Loading, None) => (ModelFaultKind::TooSlow, "is still being loaded".into()),
            (CallStage::Waiting, _) => self.schedule.cause_of_wait(&lambda.id, now),
            (CallStage::Running(_), _) => (ModelFaultKind::TooSlow, "is still running".into()),
        };
        let message = format!("model `{}` {state} at the deadline", call.model);
        lambda.fail(call.id, kind, message);
        self.sessions.count_failed(call.session);
        self.abandon(id, call.stage);
    }

    /// Ends the work for a call that is not answered any more.
    fn abandon(&mut self, id: LambdaId, stage: CallStage) {
        match stage {
            CallStage::Loading => {}
            CallStage::Waiting => self.schedule.remove(id),
            CallStage::Running(job) => self.schedule.stop(Some(job)),
        }
    }

    fn remove_gone(&mut self) {
        for (id, call) in self.lambdas.remove_gone() {
            self.abandon(id, call.stage);
        }
    }

    /// Checks the threads, and reports the status once in a second.
    fn tick(&mut self) -> Result<(), EngineError> {
        let now = Instant::now();
        if let Some(work) = self.threads.overdue(now) {
            return Err(EngineError::Overdue(work));
        }
        if self.threads.have_ended() {
            return Err(EngineError::Thread);
        }
        if now < self.status_at {
            return Ok(());
        }
        self.status_at = now + STATUS_INTERVAL;
        self.lambdas.begin_second();
        for session in self.sessions.remove_unused(|key| self.lambdas.use_session(key), now) {
            self.threads.remove_model(session);
        }
        let status = self.current_status();
        let same_memory =
            InferenceStatus { resident_bytes: self.status.resident_bytes, ..status.clone() };
        if same_memory != self.status || now >= self.reported + SILENCE {
            self.reported = now;
            self.status = status.clone();
            (self.reports)(InferenceReport::Status(status));
        }
        Ok(())
    }

    fn current_status(&self) -> InferenceStatus {
        InferenceStatus {
            models: self.sessions.reports(|key| self.lambdas.users(key)),
            clients: self.lambdas.len(),
            waiting: self.lambdas.waiting(),
            resident_bytes: usage::resident(),
        }
    }
}
