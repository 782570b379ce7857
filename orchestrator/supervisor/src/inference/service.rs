//! Starts the process, connects lambdas to it, and starts it again after it has ended.
//!
//! The socket of a lambda outlives the process: the next one uses the same. A model that was
//! loading or running at several ends of the process is not loaded again.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::FileExt;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, PlainFile, chain};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::{Manifest, ModelSpec};
use gleaner_lambda::{BuildDir, InferenceLimits};
use gleaner_parts::Parts;
use gleaner_protocol::inference::{
    AddClient, GrantedModel, InferenceControl, ModelClient, ModelEngine, ModelFile,
};
use gleaner_protocol::link::LinkError;
use gleaner_protocol::{Handover, SHUTDOWN_TIMEOUT};
use rustix::fs::{MemfdFlags, memfd_create};

use super::client::{Client, ProcessState};
use super::engine;
use super::totals::ModelTotals;
use super::{INFERENCE, InferenceEvent};
use crate::lines::{next_report, pass_on};
use crate::process::ended;
use crate::restart_delay::{ServiceDelays, was_killed};

/// Number of ends of the process that a model may cause before it is refused.
const ENDS_MAX: u32 = 3;

/// Length of a digest in the file of running models: one of the model that loads, then one of the
/// model that runs.
const DIGEST: usize = 64;

/// Time after which a process was healthy: earlier ends do not count any more.
const HEALTHY: Duration = Duration::from_secs(60);

const POLL_INTERVAL: Duration = Duration::from_millis(20);

type Events = Arc<dyn Fn(InferenceEvent) + Send + Sync>;

/// The process, over all its restarts. Dropping it ends the process.
pub struct InferenceService {
    shared: Arc<Shared>,
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
    models: Vec<PassedModel>,
    clients: Vec<Client>,
    /// Number of ends of the process at which a model was loading or running, by its digest.
    ends: BTreeMap<String, u32>,
    stops: bool,
}

/// A model that the process may load.
struct PassedModel {
    model: ModelFile,
    file: File,
    /// Entry with its engine.
    engine: Option<File>,
}

impl InferenceService {
    /// Starts the process with these limits. If the folder `engines` is given, it builds engines
    /// into it.
    ///
    /// # Errors
    ///
    /// A failure if it cannot be started.
    pub fn start(
        parts: &Parts,
        limits: &InferenceLimits,
        engines: Option<&Path>,
        events: impl Fn(InferenceEvent) + Send + Sync + 'static,
    ) -> Result<InferenceService, Failure> {
        let program = parts.program(INFERENCE)?;
        let failed = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, format!("cannot start `{INFERENCE}`"), error)
        };
        let running = memfd_create("gleaner-running", MemfdFlags::CLOEXEC);
        let running = File::from(running.map_err(|error| failed(&error))?);
        let shared = Arc::new(Shared::default());
        let (events, totals) = (Arc::new(events), Arc::default());
        let mut supervisor = Supervisor {
            program,
            limits: *limits,
            engines: engines.map(Path::to_owned),
            shared: Arc::clone(&shared),
            running,
            events,
            totals,
        };
        let child = supervisor.start().map_err(|error| failed(&*error))?;
        let supervisor = thread::Builder::new()
            .name("inference".to_owned())
            .spawn(move || supervisor.supervise(child))
            .map_err(|error| failed(&error))?;
        Ok(InferenceService { shared, supervisor: Some(supervisor) })
    }

    /// Adds a lambda, whose build is `build`, under the name `name`; returns its end of the
    /// connection.
    ///
    /// # Errors
    ///
    /// A failure if the file of a model cannot be opened.
    pub fn add(
        &self,
        name: &str,
        build: &BuildDir,
        manifest: &Manifest,
    ) -> Result<OwnedFd, Failure> {
        let models = manifest.models.iter().map(|model| PassedModel::open(model, build.path()));
        let models: Vec<PassedModel> = models.collect::<Result<_, _>>()?;
        let (lambda_end, socket) = ModelClient::pair().map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot connect to `{INFERENCE}`"), &error)
        })?;
        let granted = manifest.models.iter().map(granted).collect();
        let mut state = self.shared.lock();
        for passed in models {
            if !state.models.iter().any(|known| known.model.sha256 == passed.model.sha256) {
                state.pass_model(&passed);
                state.models.push(passed);
            }
        }
        let memory = manifest.limits.memory.bytes();
        let add = AddClient { name: name.to_owned(), memory, models: granted };
        let client = Client::new(add, socket);
        // Processes that have ended, such as the one before this, leave their socket here.
        state.clients.retain(|client| !client.has_ended());
        state.pass_client(&client);
        state.clients.push(client);
        Ok(lambda_end)
    }

    /// Ends the process.
    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
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

impl Drop for InferenceService {
    fn drop(&mut self) {
        self.end();
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

    fn pass_model(&mut self, passed: &PassedModel) {
        let PassedModel { model, file, engine } = passed;
        let engine = engine.as_ref().map(AsFd::as_fd);
        self.pass(|control| control.add_model(model, file.as_fd(), engine));
    }

    fn pass_client(&mut self, client: &Client) {
        let mut add = client.add.clone();
        for model in &mut add.models {
            let ends = self.ends.get(&model.sha256).copied().unwrap_or(0);
            model.refused = (ends >= ENDS_MAX).then(|| {
                format!(
                    "{INFERENCE} has ended {ends} times while model `{}` was loading or running: \
                     it is not loaded again in this run",
                    model.name
                )
            });
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

    /// Passes everything to a process that has started.
    fn pass_all(&mut self) {
        let (models, clients) =
            (std::mem::take(&mut self.models), std::mem::take(&mut self.clients));
        models.iter().for_each(|passed| self.pass_model(passed));
        self.models = models;
        for mut client in clients {
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
struct Supervisor {
    program: PathBuf,
    limits: InferenceLimits,
    /// Folder in which engines are built instead of running models.
    engines: Option<PathBuf>,
    shared: Arc<Shared>,
    /// The file in which the process notes the digests of models that it loads and runs.
    running: File,
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
            let mut is_killed = false;
            let reason = match current.and_then(|child| self.wait(child)) {
                Ok(status) => {
                    is_killed = was_killed(status);
                    ended(INFERENCE, status)
                }
                Err(reason) => reason,
            };
            let mut state = self.shared.lock();
            if state.stops {
                return;
            }
            state.control = None;
            let blamed = self.blame(&mut state, is_killed);
            let reason = match &blamed {
                Some((_, what)) => format!("{reason}, {what}"),
                None => reason,
            };
            let state_of_client = || ProcessState::Ended(reason.clone());
            state.clients.retain_mut(|client| client.report(state_of_client()));
            if started.elapsed() >= HEALTHY {
                state.ends.retain(|digest, _| blamed.as_ref().is_some_and(|it| it.0 == *digest));
            }
            drop(state);
            let delay = delays.after(started.elapsed(), is_killed);
            // Not under the lock: the receiver may add a lambda before it reads this.
            (self.events)(InferenceEvent::Ended(reason, delay));
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
        let child = Command::new(&self.program)
            .args(["--memory".to_owned(), memory.bytes().to_string()])
            .args(["--run-max".to_owned(), run_max.as_secs_f64().to_string()])
            .args(["--load-max".to_owned(), load_max.as_secs_f64().to_string()])
            .args(self.engines.iter().flat_map(|folder| [Path::new("--build-engines"), folder]))
            // Wheels of ONNX Runtime since 1.29 send data to Microsoft otherwise. The call that
            // switches that off comes too late for the first event.
            .env("ORT_DISABLE_TELEMETRY", "1")
            // Only `gleaner` receives Ctrl-C, and ends its processes in order.
            .process_group(0)
            .stdin(OwnedFd::from(stdin))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut process = Process { child, _handover: handover, readers: Vec::new() };
        let reader = || thread::Builder::new().name("inference output".to_owned());
        if let Some(reports) = process.child.stdout.take() {
            let (events, totals) = (Arc::clone(&self.events), Arc::clone(&self.totals));
            process.readers.push(reader().spawn(move || follow(reports, &events, &totals))?);
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

    /// Waits for the end of the process. It is killed if it does not end on request, or does not
    /// read its messages.
    fn wait(&self, mut process: Process) -> Result<ExitStatus, String> {
        let mut requested = None;
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
            if is_late || state.control.is_none() {
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
        status
    }

    /// Counts the end against the model that ran, or else the one that was loading, unless the
    /// process `is_killed`; returns its digest, and a text about it.
    fn blame(&self, state: &mut ServiceState, is_killed: bool) -> Option<(String, String)> {
        let mut digests = [0; 2 * DIGEST];
        let read = self.running.read_at(&mut digests, 0).unwrap_or(0);
        // The note counts once, even if the next process cannot be started.
        let _ = self.running.set_len(0);
        let notes = digests[..read].chunks(DIGEST).zip(["loaded", "ran"]);
        notes.rev().find_map(|(digest, what)| {
            let digest = std::str::from_utf8(digest).ok()?;
            let known = state.models.iter().find(|known| known.model.sha256 == digest)?;
            let text = format!("while it {what} `{}`", known.model.path);
            *state.ends.entry(digest.to_owned()).or_default() += u32::from(!is_killed);
            Some((digest.to_owned(), text))
        })
    }
}

struct Process {
    child: Child,
    /// Open, as its end would mean that this program has ended.
    _handover: UnixStream,
    readers: Vec<JoinHandle<()>>,
}

impl Drop for Process {
    fn drop(&mut self) {
        if let Ok(None) = self.child.try_wait() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

fn follow(reports: impl Read, events: &Events, totals: &Mutex<ModelTotals>) {
    let mut reports = BufReader::new(reports);
    let mut line = Vec::new();
    while next_report(&mut reports, &mut line).unwrap_or(false) {
        match serde_json::from_slice(&line) {
            Ok(mut report) => {
                totals.lock().unwrap_or_else(PoisonError::into_inner).add_to(&mut report);
                events(InferenceEvent::Report(report));
            }
            Err(error) => {
                let text = format!("cannot parse a report of {INFERENCE}: {error}");
                events(InferenceEvent::Warning(text));
            }
        }
    }
}

fn granted(model: &ModelSpec) -> GrantedModel {
    GrantedModel {
        name: model.name.to_string(),
        sha256: model.sha256.to_string(),
        providers: model.providers.clone(),
        threads: u32::try_from(model.threads).ok(),
        refused: None,
    }
}

impl PassedModel {
    /// Opens the file of a model in the build `build`, and its engine if there is one.
    fn open(model: &ModelSpec, build: &Path) -> Result<Self, Failure> {
        let file = PlainFile::inside(build, model.file.as_path(), FILE_MAX);
        let file = file.map(PlainFile::into_file).map_err(|error| {
            let message =
                format!("cannot open `{}`, the file of model `{}`", model.file, model.name);
            Failure::caused_by(Exit::Usage, message, &error)
                .with_help("build the lambda again: gleaner build DIR")
        })?;
        let (sha256, path) = (model.sha256.to_string(), model.file.to_string());
        let (engine, entry) = match engine::stored(&sha256) {
            Ok(Some(entry)) => (ModelEngine::Attached, Some(entry)),
            Ok(None) => (ModelEngine::None, None),
            Err(reason) => (ModelEngine::Refused(reason), None),
        };
        Ok(Self { model: ModelFile { sha256, path, engine }, file, engine: entry })
    }
}
