//! The loop: owns the lambdas, the sessions and the order of runs. It never waits for a lambda or a
//! model.

use std::collections::HashMap;
use std::fs::File;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_protocol::inference::{
    InferenceReport, InferenceRequest, InferenceServer, InferenceStatus, ModelCall, ModelEngine,
    ModelFaultKind, ModelFile, ModelRequest, ModelResult, TensorPlace,
};
use gleaner_protocol::link::Incoming;
use gleaner_vitals::{monotonic_ns, usage};
use tracing::{error, info};

use crate::backend::StopSignal;
use crate::client::{CallStage, ConnectedLambda, LambdaId, OpenCall};
use crate::engine_error::EngineError;
use crate::lambdas::{LambdaTable, ReadyDescriptors, TOO_MANY};
use crate::loader::{LoadDone, LoadJob, PassedEngine};
use crate::loads::LoadQueue;
use crate::places::{PlacedInput, check_inputs};
use crate::queue::FairQueue;
use crate::sessions::{LoadState, SessionId, SessionKey, SessionTable};
use crate::threads::{ModelThreads, ThreadResult};
use crate::worker::{LastRun, RunDone, RunJob, RunOutputs, WorkerModel, WorkerRequest};

const STATUS_INTERVAL: Duration = Duration::from_secs(1);
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
    /// Files by digest.
    files: HashMap<String, PassedModel>,
    sessions: SessionTable,
    loads: LoadQueue,
    queue: FairQueue<LambdaId, Vec<PlacedInput>>,
    run: Option<RunInProgress>,
    last_job: u64,
    status_at: Instant,
    status: InferenceStatus,
}

/// A file that the starter has passed.
struct PassedModel {
    path: String,
    file: Arc<File>,
    engine: PassedEngine,
}

struct RunInProgress {
    job: u64,
    lambda: LambdaId,
    stop: Arc<StopSignal>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EngineEnd {
    Stopped,
    StarterEnded,
}

impl InferenceEngine {
    pub(crate) fn new(threads: ModelThreads, reports: ReportSink) -> Self {
        Self {
            threads,
            reports,
            lambdas: LambdaTable::default(),
            files: HashMap::new(),
            sessions: SessionTable::default(),
            loads: LoadQueue::default(),
            queue: FairQueue::default(),
            run: None,
            last_job: 0,
            status_at: Instant::now() + STATUS_INTERVAL,
            status: InferenceStatus::default(),
        }
    }

    /// Serves lambdas until the starter sends stop or ends, or until `stop` is readable.
    ///
    /// # Errors
    ///
    /// [`EngineError`]: the starter starts the process again.
    pub(crate) fn run(
        mut self,
        mut control: InferenceServer,
        stop: Option<&OwnedFd>,
    ) -> Result<(), EngineError> {
        (self.reports)(InferenceReport::Ready);
        let end = self.serve(&mut control, stop)?;
        info!(reason = ?end, "gleaner-inference ends");
        if let Some(run) = &self.run {
            run.stop.stop();
        }
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
            self.start_run();
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
        if let Some(deadline) = self.lambdas.next_deadline() {
            timeout = timeout.min(Duration::from_nanos(deadline.saturating_sub(monotonic_ns())));
        }
        self.lambdas.wait(control, self.threads.wake(), stop, timeout).map_err(EngineError::Wait)
    }

    fn handle_control(&mut self, control: &mut InferenceServer) -> Option<EngineEnd> {
        loop {
            match control.poll() {
                Ok(Incoming::Message(InferenceRequest::Model(model, file, entry))) => {
                    let ModelFile { sha256, path, engine } = model;
                    let entry = entry.map(|it| Arc::new(File::from(it)));
                    let engine = match engine {
                        ModelEngine::Refused(reason) => Err(reason),
                        ModelEngine::None | ModelEngine::Attached => Ok(entry),
                    };
                    let file = Arc::new(File::from(file));
                    self.files.insert(sha256, PassedModel { path, file, engine });
                }
                Ok(Incoming::Message(InferenceRequest::Client(add, socket))) => {
                    self.lambdas.add(add, socket);
                }
                Ok(Incoming::Message(InferenceRequest::Stop)) => return Some(EngineEnd::Stopped),
                Ok(Incoming::Nothing) => return None,
                Ok(Incoming::Ended) => return Some(EngineEnd::StarterEnded),
                Err(why) => {
                    let error = &why as &dyn std::error::Error;
                    error!(error, "the connection to the starter failed");
                    return Some(EngineEnd::StarterEnded);
                }
            }
        }
    }

    fn handle_request(&mut self, id: LambdaId, request: ModelRequest) {
        self.expire(id, monotonic_ns());
        let Some(lambda) = self.lambdas.get_mut(id) else { return };
        // It has given up the call before: its time was over, or it made that call to a process
        // before this one.
        let before = lambda.call.take();
        if let Some(before) = before {
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
            Some(session) => session,
            None => match self.load(key) {
                Ok(session) => session,
                Err(message) => {
                    let Some(lambda) = self.lambdas.get_mut(id) else { return };
                    return lambda.fail(call, ModelFaultKind::Failed, message);
                }
            },
        };
        if let Some(lambda) = self.lambdas.get_mut(id) {
            let (outputs, stage) = (0, CallStage::Loading);
            lambda.call = Some(OpenCall { id: call, deadline_ns, model, session, outputs, stage });
        }
        self.answer_open(id);
    }

    /// Begins to load a model.
    fn load(&mut self, key: SessionKey) -> Result<SessionId, String> {
        let Some(PassedModel { path, file, engine }) = self.files.get(&key.sha256) else {
            return Err(format!("the starter passed no file with the digest {}", key.sha256));
        };
        let (path, file, engine) = (path.clone(), Arc::clone(file), engine.clone());
        let lambdas = self.lambdas.users(&key);
        let session = self.sessions.add(key.clone(), path.clone());
        self.loads.push(LoadJob { session, key, file, engine, path, lambdas });
        Ok(session)
    }

    /// Starts the next load, if none is in progress.
    fn start_load(&mut self) {
        if let Some(job) = self.loads.begin(&self.lambdas, &mut self.sessions) {
            self.threads.load(job);
        }
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
                let opened = ModelResult::Opened {
                    inputs: ready.inputs.clone(),
                    outputs: ready.outputs.clone(),
                    runtime: ready.runtime.clone(),
                    metadata: ready.metadata.clone(),
                };
                lambda.opened.insert(call.model);
                lambda.reply(call.id, Ok(opened), None, 0);
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
                self.queue.push(id, deadline_ns, placed);
            }
            Err(error) => {
                let message = format!("model `{model}`: {error}");
                lambda.fail(call, ModelFaultKind::WrongInput, message);
                self.sessions.count_failed(session);
            }
        }
    }

    /// Starts the next run, if none is in progress.
    fn start_run(&mut self) {
        while self.run.is_none() {
            let Some((id, inputs)) = self.queue.pop() else { return };
            let Some(lambda) = self.lambdas.get_mut(id) else { continue };
            let Some(call) = &mut lambda.call else { continue };
            self.last_job += 1;
            let (job, stop) = (self.last_job, Arc::new(StopSignal::default()));
            let left =
                call.deadline_ns.map(|at| Duration::from_nanos(at.saturating_sub(monotonic_ns())));
            call.stage = CallStage::Running(job);
            self.threads.request(WorkerRequest::Run(RunJob {
                job,
                session: call.session,
                lambda: lambda.name.clone(),
                inputs,
                input_region: lambda.inputs.clone(),
                output_region: lambda.outputs.clone(),
                memory: lambda.memory,
                left,
                stop: Arc::clone(&stop),
            }));
            self.run = Some(RunInProgress { job, lambda: id, stop });
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
                    outputs: ready.outputs.clone(),
                    last: LastRun::default(),
                };
                self.threads.request(WorkerRequest::Add(id, model));
                LoadState::Ready(ready)
            }
            Err(reason) => LoadState::Failed(reason),
        };
        let key = session.key.clone();
        for lambda in self.lambdas.with_call_on(id) {
            self.answer_open(lambda);
        }
        let users = self.lambdas.users(&key);
        if let Some(report) = self.sessions.report(id, users) {
            (self.reports)(InferenceReport::Model(report));
        }
    }

    fn finish_run(&mut self, done: RunDone) {
        let RunDone { job, session, result, ran_ns } = done;
        let Some(run) = self.run.take_if(|run| run.job == job) else { return };
        let waits = |call: &mut OpenCall| call.stage == CallStage::Running(job);
        let lambda = self.lambdas.get_mut(run.lambda);
        let answered = lambda.and_then(|it| Some((it.call.take_if(waits)?, it)));
        if let Some(session) = self.sessions.get_mut(session) {
            let counts = &mut session.counts;
            counts.runs += u64::from(ran_ns.is_some());
            counts.run_ns = counts.run_ns.saturating_add(ran_ns.unwrap_or(0));
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
            (CallStage::Loading, None) => (ModelFaultKind::TooSlow, "is still being loaded".into()),
            (CallStage::Waiting, _) => {
                (ModelFaultKind::TooSlow, "has not run yet: others run before it".into())
            }
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
            CallStage::Waiting => drop(self.queue.remove(id)),
            CallStage::Running(job) => {
                if let Some(run) = self.run.as_ref().filter(|run| run.job == job) {
                    run.stop.stop();
                }
            }
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
            self.threads.request(WorkerRequest::Remove(session));
        }
        let status = self.current_status();
        let same_memory =
            InferenceStatus { resident_bytes: self.status.resident_bytes, ..status.clone() };
        if same_memory != self.status {
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
