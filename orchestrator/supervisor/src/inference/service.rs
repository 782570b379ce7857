//! Starts the process, connects lambdas to it, and starts it again after it has ended.
//!
//! The socket of a lambda outlives the process: the next one uses the same. A model that ended
//! several processes is not used again.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::File;
use std::io::{BufReader, Read};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::{Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure, chain};
use gleaner_lambda::manifest::{Manifest, ScheduleSpec};
use gleaner_lambda::{BuildDir, InferenceLimits};
use gleaner_protocol::inference::{
    AddClient, InferenceControl, InferenceReport, ModelMemory, TryLoad, models_in_use,
};
use gleaner_protocol::link::LinkError;
use gleaner_protocol::{Handover, SHUTDOWN_TIMEOUT};
use rustix::fs::{MemfdFlags, memfd_create};

use super::blame::Blame;
use super::client::{Client, ProcessState};
use super::passed_model::{PassedModel, granted};
use super::process::{Process, START, STEP};
use super::totals::ModelTotals;
use super::trial::LoadTrial;
use super::{INFERENCE, InferenceEvent, InferenceUse};
use crate::last_error::unexpected_end;
use crate::lines::{next_report, pass_on};
use crate::restart_delay::{SILENCE, ServiceDelays, was_killed};

const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// The reason why a load must not happen, if there is one, and the memory that it took.
type TrialResult = (Option<String>, ModelMemory);

type Events = Arc<dyn Fn(InferenceEvent) + Send + Sync>;

/// The process, over all its restarts. Dropping it ends the process.
pub struct InferenceService {
    shared: Arc<Shared>,
    /// Lambdas whose files are to be checked, one lambda at a time.
    unchecked: Sender<Client>,
    supervisor: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    state: Mutex<ServiceState>,
    /// Notified when the service is to end.
    stops: Condvar,
}

#[derive(Default)]
struct ServiceState {
    /// The connection to the current process; `None` between two.
    control: Option<InferenceControl>,
    clients: Vec<Client>,
    blame: Blame,
    /// `None` while a trial is in progress.
    trials: BTreeMap<TryLoad, Option<TrialResult>>,
    stops: bool,
}

impl InferenceService {
    /// Starts the process with these limits, for `purpose`.
    ///
    /// # Errors
    ///
    /// A failure if it cannot be started.
    pub fn start(
        parts: &InstalledPrograms,
        limits: &InferenceLimits,
        purpose: InferenceUse<'_>,
        events: impl Fn(InferenceEvent) + Send + Sync + 'static,
    ) -> Result<InferenceService, Failure> {
        let args = match purpose {
            InferenceUse::Shared => vec!["--trials".into()],
            InferenceUse::OneLambda => Vec::new(),
            InferenceUse::Engines(folder) => vec!["--build-engines".into(), folder.into()],
        };
        Self::launch(parts.program(INFERENCE)?, *limits, args, events)
    }

    pub(super) fn launch(
        program: PathBuf,
        limits: InferenceLimits,
        args: Vec<OsString>,
        events: impl Fn(InferenceEvent) + Send + Sync + 'static,
    ) -> Result<InferenceService, Failure> {
        let failed = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, format!("cannot start `{INFERENCE}`"), error)
        };
        let running = memfd_create("gleaner-running", MemfdFlags::CLOEXEC);
        let running = File::from(running.map_err(|error| failed(&error))?);
        let shared = Arc::new(Shared::default());
        let (events, totals): (Events, _) = (Arc::new(events), Arc::default());
        let (unchecked, clients) = channel::<Client>();
        let (of_checks, refused) = (Arc::clone(&shared), Arc::clone(&events));
        let check = move || {
            for mut client in clients {
                let reasons = client.check_files();
                of_checks.lock().connect(client);
                reasons.into_iter().for_each(|reason| refused(InferenceEvent::Refused(reason)));
            }
        };
        let checks = thread::Builder::new().name("digests".to_owned()).spawn(check);
        checks.map_err(|error| failed(&error))?;
        let mut supervisor = Supervisor {
            program,
            limits,
            args,
            shared: Arc::clone(&shared),
            running: Arc::new(running),
            events: Arc::clone(&events),
            totals,
        };
        let child = supervisor.start().map_err(|error| failed(&*error))?;
        let supervisor = thread::Builder::new()
            .name("inference".to_owned())
            .spawn(move || supervisor.supervise(child))
            .map_err(|error| failed(&error))?;
        Ok(InferenceService { shared, unchecked, supervisor: Some(supervisor) })
    }

    /// Adds a lambda with this identity, whose build is `build`; returns its end of the connection.
    /// It is connected once the digests of its files are computed, for which the caller must not
    /// wait. The lambda waits for the reply to its first call.
    ///
    /// # Errors
    ///
    /// A failure if the file of a model cannot be opened. One with another digest than stated is
    /// refused when the lambda opens it.
    pub fn add(&self, id: &str, build: &BuildDir, manifest: &Manifest) -> Result<OwnedFd, Failure> {
        // A manifest may list one file many times.
        let files = manifest.models.iter().map(|it| ((it.file.as_path(), it.sha256.as_str()), it));
        let files = files.collect::<BTreeMap<_, _>>().into_values();
        let models = files.map(|model| PassedModel::open(model, build.path()));
        let models = models.collect::<Result<_, _>>()?;
        let (id, name) = (id.to_owned(), manifest.lambda.name.to_string());
        let ns = |time: Duration| time.as_nanos() as u64;
        let demand = manifest.demand.model_time.map(ns);
        let rate = manifest.demand.rate_hz.map(|hz| Duration::from_secs_f64(1.0 / hz));
        let period = match manifest.schedule {
            ScheduleSpec::Periodic { period } => Some(period),
            ScheduleSpec::Event { .. } => rate,
        };
        let pace = period.map(|it| [demand.unwrap_or(ns(manifest.limits.model_time)), ns(it)]);
        let memory = manifest.limits.memory.bytes();
        let granted = manifest.models.iter().map(granted).collect();
        let add = AddClient { id, name, demand, pace, memory, models: granted };
        let (lambda_end, client) = Client::pair(add, models)?;
        let ended = |_| Failure::new(Exit::Internal, "the thread that checks models has ended");
        self.unchecked.send(client).map_err(ended)?;
        Ok(lambda_end)
    }

    /// Connects a lambda whose file is checked already.
    pub(super) fn connect(&self, add: AddClient, file: PassedModel) -> Result<OwnedFd, Failure> {
        let (lambda_end, client) = Client::pair(add, vec![file])?;
        self.shared.lock().connect(client);
        Ok(lambda_end)
    }

    /// Ends the process, and waits for that.
    pub fn stop(self) {
        drop(self);
    }
}

impl Drop for InferenceService {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        state.stops = true;
        if let Some(control) = &state.control {
            // Fails if it has ended meanwhile.
            let _ = control.stop();
        }
        drop(state);
        self.shared.stops.notify_all();
        if let Some(supervisor) = self.supervisor.take() {
            // It has reported a panic already.
            let _ = supervisor.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, ServiceState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for `delay`; returns early, and true, if the service is to end.
    fn stops_within(&self, delay: Duration) -> bool {
        let until = Instant::now() + delay;
        let mut state = self.lock();
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if state.stops || left.is_zero() {
                return state.stops;
            }
            let step = if state.send_states() { POLL_INTERVAL.min(left) } else { left };
            let waited = self.stops.wait_timeout(state, step);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl ServiceState {
    // An error of the connection means that the process has ended, or does not read and is killed:
    // the next one gets everything again.

    fn connect(&mut self, client: Client) {
        // Processes that have ended, such as the one before this, leave their socket here.
        self.clients.retain(|client| !client.has_ended());
        self.pass_client(&client);
        self.clients.push(client);
    }

    fn pass_client(&mut self, client: &Client) {
        let mut add = client.add.clone();
        for model in &mut add.models {
            let refusal = || self.blame.refusal(&model.sha256, &add.id).cloned();
            model.refused = model.refused.take().or_else(refusal);
        }
        for PassedModel { model, file, engine } in &client.models {
            let engine = engine.as_ref().map(AsFd::as_fd);
            self.pass(|control| control.add_model(model, file.as_fd(), engine));
        }
        self.pass(|control| control.add_client(&add, client.socket.as_fd()));
    }

    fn pass(&mut self, send: impl FnOnce(&InferenceControl) -> Result<(), LinkError>) {
        if let Some(control) = &self.control
            && send(control).is_err()
        {
            self.control = None;
        }
    }

    /// Passes all lambdas to a process that has started.
    fn pass_all(&mut self) {
        for mut client in std::mem::take(&mut self.clients) {
            if client.report(ProcessState::Started) {
                self.pass_client(&client);
                self.clients.push(client);
            }
        }
    }

    /// Sends the states that had no room; returns whether one still has none.
    fn send_states(&mut self) -> bool {
        self.clients.retain_mut(Client::send_state);
        self.clients.iter().any(Client::has_unsent)
    }
}

/// The thread that starts the process and waits for its end.
#[derive(Clone)]
struct Supervisor {
    program: PathBuf,
    limits: InferenceLimits,
    /// Further arguments of the process.
    args: Vec<OsString>,
    shared: Arc<Shared>,
    /// The file in which the process notes the models that it loads and runs.
    running: Arc<File>,
    events: Events,
    totals: Arc<Mutex<ModelTotals>>,
}

type StartError = Box<dyn std::error::Error + Send + Sync>;

impl Supervisor {
    fn supervise(mut self, child: Process) {
        let mut delays = ServiceDelays::new();
        let mut current = Ok(child);
        loop {
            let started = Instant::now();
            let (mut is_killed, mut is_fault) = (false, false);
            let reason = match current.and_then(|child| self.wait(child)) {
                Ok(status) => {
                    is_killed = was_killed(status);
                    is_fault = !is_killed;
                    unexpected_end(INFERENCE, status)
                }
                Err(reason) => reason,
            };
            let mut state = self.shared.lock();
            if state.stops {
                return;
            }
            state.control = None;
            let notes = models_in_use(&self.running);
            // The notes count once, even if the next process cannot be started.
            let _ = self.running.set_len(0);
            let ServiceState { blame, clients, .. } = &mut *state;
            let file = |sha256: &str| clients.iter().find_map(|client| client.file(sha256));
            let model = |sha256: &str| file(sha256).map(|passed| passed.model.clone());
            let (reason, refusal) = blame.charge(notes, model, reason, is_fault);
            let state_of_client = || ProcessState::Ended(reason.clone());
            state.clients.retain_mut(|client| client.report(state_of_client()));
            drop(state);
            let delay = delays.after(started.elapsed(), is_killed);
            // Not under the lock: the receiver may add a lambda before it reads this.
            (self.events)(InferenceEvent::Ended(reason, delay, is_fault));
            refusal.into_iter().for_each(|text| (self.events)(InferenceEvent::Refused(text)));
            if self.shared.stops_within(delay) {
                return;
            }
            current = self
                .start()
                .map_err(|error| format!("{INFERENCE} could not be started: {}", chain(&*error)));
        }
    }

    /// Starts the process, and passes it all models and lambdas.
    fn start(&mut self) -> Result<Process, StartError> {
        let (control, process_end) = InferenceControl::pair()?;
        let (handover, stdin) = UnixStream::pair()?;
        let running = Some(self.running.try_clone()?.into());
        Handover { control: Some(process_end), running, ..Handover::default() }.send(&handover)?;
        let InferenceLimits { memory, run_max, load_max } = self.limits;
        let apart = self.shared.lock().blame.apart_for();
        let child = Command::new(&self.program)
            .args(["--memory".to_owned(), memory.bytes().to_string()])
            .args(["--run-max".to_owned(), run_max.as_secs_f64().to_string()])
            .args(["--load-max".to_owned(), load_max.as_secs_f64().to_string()])
            .args(["--apart".to_owned(), apart.as_secs().to_string()])
            .args(&self.args)
            // Wheels of ONNX Runtime since 1.29 send data to Microsoft otherwise. The call that
            // switches that off comes too late for the first event.
            .env("ORT_DISABLE_TELEMETRY", "1")
            // Only `gleaner` receives Ctrl-C, and ends its processes in order.
            .process_group(0)
            .stdin(OwnedFd::from(stdin))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut process = Process { child, handover, readers: Vec::new(), reports: Arc::default() };
        let reader = || thread::Builder::new().name("inference output".to_owned());
        if let Some(reports) = process.child.stdout.take() {
            let (count, supervisor) = (Arc::clone(&process.reports), self.clone());
            let follow = move || supervisor.follow(reports, &count);
            process.readers.push(reader().spawn(follow)?);
        }
        if let Some(stderr) = process.child.stderr.take() {
            let events = Arc::clone(&self.events);
            let forward = move || {
                pass_on(stderr, &AtomicBool::new(false), |piece| {
                    events(InferenceEvent::Stderr(piece.to_vec()));
                });
            };
            process.readers.push(reader().spawn(forward)?);
        }
        let mut state = self.shared.lock();
        state.control = Some(control);
        state.pass_all();
        drop(state);
        Ok(process)
    }

    /// Waits for the end of the process. It is killed if it does not end on request, does not read
    /// its messages, or stands still.
    fn wait(&self, mut process: Process) -> Result<ExitStatus, String> {
        let (mut requested, mut is_silent) = (None, false);
        let (mut seen, mut since, mut looked) = (0, Instant::now(), Instant::now());
        let status = loop {
            match process.child.try_wait() {
                Ok(Some(status)) => break Ok(status),
                Ok(None) => {}
                Err(error) => break Err(format!("cannot wait for {INFERENCE}: {error}")),
            }
            let mut state = self.shared.lock();
            state.send_states();
            if state.stops {
                requested.get_or_insert_with(Instant::now);
            }
            let is_late = requested.is_some_and(|at: Instant| at.elapsed() > SHUTDOWN_TIMEOUT);
            let (count, now) = (process.reports.load(Ordering::Relaxed), Instant::now());
            if count != seen || now.duration_since(looked) > STEP {
                (seen, since) = (count, now);
            }
            looked = now;
            is_silent |= now.duration_since(since) > if seen == 1 { START } else { SILENCE };
            if is_late || is_silent || state.control.is_none() {
                // It may have ended meanwhile.
                let _ = process.child.kill();
            }
            drop(self.shared.stops.wait_timeout(state, POLL_INTERVAL));
        };
        // Its last words come before the report of its end.
        for reader in std::mem::take(&mut process.readers) {
            let _ = reader.join();
        }
        self.totals.lock().unwrap_or_else(PoisonError::into_inner).end_process();
        if is_silent { Err(format!("{INFERENCE} stood still, and was killed")) } else { status }
    }

    /// Reads the reports of the process, and counts them.
    fn follow(&self, reports: impl Read, count: &AtomicU64) {
        let mut reports = BufReader::new(reports);
        let mut line = Vec::new();
        while next_report(&mut reports, &mut line).unwrap_or(false) {
            count.fetch_add(1, Ordering::Relaxed);
            match serde_json::from_slice(&line) {
                Ok(InferenceReport::Try(load)) => self.try_load(load),
                Ok(mut report) => {
                    let mut totals = self.totals.lock().unwrap_or_else(PoisonError::into_inner);
                    totals.add_to(&mut report);
                    drop(totals);
                    (self.events)(InferenceEvent::Report(report));
                }
                Err(error) => {
                    let text = format!("cannot parse a report of {INFERENCE}: {error}");
                    (self.events)(InferenceEvent::Warning(text));
                }
            }
        }
    }

    /// Tries a load in a process of its own, unless the result is known, and sends the result to
    /// the process that runs then.
    fn try_load(&self, load: TryLoad) {
        let mut state = self.shared.lock();
        let known = state.clients.iter().find_map(|client| {
            let mut granted = client.add.models.iter();
            let granted = granted.find(|it| it.refused.is_none() && it.load() == load)?;
            Some((client.add.clone(), granted.clone(), client.file(&load.sha256)?.clone()))
        });
        let Some((add, granted, model)) = known else {
            let why = Some("the model cannot be tried: its lambda has ended");
            return state.pass(|control| control.tried(&load, why, ModelMemory::default()));
        };
        match state.trials.get(&load).cloned() {
            Some(None) => return,
            Some(Some((refused, memory))) => {
                return state.pass(|control| control.tried(&load, refused.as_deref(), memory));
            }
            None => drop(state.trials.insert(load.clone(), None)),
        }
        drop(state);
        let (of_thread, of_trial) = (self.clone(), load.clone());
        let run = move || {
            let Supervisor { program, limits, shared, .. } = of_thread.clone();
            let add = AddClient { models: vec![granted], ..add };
            let trial = LoadTrial { program, limits, add, model, memory: Cell::default() };
            // The process waits for the result.
            let tried = catch_unwind(AssertUnwindSafe(|| trial.run(|| shared.lock().stops)))
                .unwrap_or_else(|_| Err("the trial of a model failed: see standard error".into()));
            of_thread.end_trial(&of_trial, tried, trial.memory.get());
        };
        if let Err(error) = thread::Builder::new().name("trial".to_owned()).spawn(run) {
            let why = format!("a model cannot be tried: {error}");
            self.end_trial(&load, Err(why), ModelMemory::default());
        }
    }

    /// Sends the result of a trial to the process that runs now.
    fn end_trial(
        &self,
        load: &TryLoad,
        tried: Result<Option<String>, String>,
        memory: ModelMemory,
    ) {
        let mut state = self.shared.lock();
        let refused = tried.clone().unwrap_or_else(Some);
        state.pass(|control| control.tried(load, refused.as_deref(), memory));
        state.trials.remove(load);
        if tried.is_ok() {
            state.trials.insert(load.clone(), Some((refused, memory)));
        }
        drop(state);
        match tried {
            Ok(None) => {}
            Ok(Some(reason)) => (self.events)(InferenceEvent::Refused(reason)),
            Err(reason) => (self.events)(InferenceEvent::Warning(reason)),
        }
    }
}
