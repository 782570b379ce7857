//! Supervises `gleaner-inference`, the process that runs the models of all lambdas of a run or of a
//! replay: starts it, connects lambdas to it, and starts it again after it has ended.
//!
//! The socket of a lambda outlives the process: the next one uses the same. A model that was
//! loading or running at several ends of the process is not loaded again.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::FileExt;
use std::os::unix::net::UnixStream;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, PlainFile, chain};
use gleaner_lambda::BuildDir;
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::{Manifest, ModelSpec};
use gleaner_parts::Parts;
use gleaner_protocol::inference::{
    AddClient, GrantedModel, InferenceControl, InferenceReport, ModelClient, ModelFile,
    report_state,
};
use gleaner_protocol::link::LinkError;
use gleaner_protocol::{Handover, SHUTDOWN_TIMEOUT};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{MemfdFlags, memfd_create};
use rustix::process::Signal;

use crate::lines::{next_report, pass_on};
use crate::restart_delay::RestartDelay;

/// Program and name of the process.
const INFERENCE: &str = "gleaner-inference";

/// Number of ends of the process that a model may cause before it is refused.
const ENDS_MAX: u32 = 3;

/// Length of a digest in the file of running models: one of the model that loads, then one of the
/// model that runs.
const DIGEST: usize = 64;

/// Time after which a process was healthy: earlier ends do not count any more.
const HEALTHY: Duration = Duration::from_secs(60);

/// Interval of looks at the process.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// An event of the process, for the user.
pub enum InferenceEvent {
    /// One of its reports.
    Report(InferenceReport),
    /// A piece of its standard error.
    Stderr(Vec<u8>),
    /// It has ended without a request, for this reason, and is started again after the delay.
    Ended(String, Duration),
    /// Something else went wrong.
    Warning(String),
}

/// Receives events, in any thread.
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
    models: Vec<(ModelFile, File)>,
    clients: Vec<Client>,
    /// Number of ends of the process at which a model was loading or running, by its digest.
    ends: BTreeMap<String, u32>,
    stops: bool,
}

/// A lambda's process.
struct Client {
    add: AddClient,
    /// The end of `gleaner-inference` of its connection.
    socket: OwnedFd,
}

impl InferenceService {
    /// Starts the process.
    ///
    /// # Errors
    ///
    /// A failure if it cannot be started.
    pub fn start(
        parts: &Parts,
        events: impl Fn(InferenceEvent) + Send + Sync + 'static,
    ) -> Result<InferenceService, Failure> {
        let program = parts.program(INFERENCE)?;
        let failed = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, format!("cannot start `{INFERENCE}`"), error)
        };
        let running = memfd_create("gleaner-running", MemfdFlags::CLOEXEC);
        let running = File::from(running.map_err(|error| failed(&error))?);
        let shared = Arc::new(Shared::default());
        let mut supervisor =
            Supervisor { program, shared: Arc::clone(&shared), running, events: Arc::new(events) };
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
        let mut files = Vec::new();
        for model in &manifest.models {
            files.push((model_file(model), open(model, build.path())?));
        }
        let (lambda_end, socket) = ModelClient::pair().map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot connect to `{INFERENCE}`"), &error)
        })?;
        let models = manifest.models.iter().map(granted).collect();
        let mut state = self.shared.lock();
        for (model, file) in files {
            if !state.models.iter().any(|(known, _)| known.sha256 == model.sha256) {
                state.pass_model(&model, &file);
                state.models.push((model, file));
            }
        }
        let memory = manifest.limits.memory.bytes();
        let client = Client { add: AddClient { name: name.to_owned(), memory, models }, socket };
        // Processes that have ended, such as the one before this, leave their socket here.
        state.clients.retain(|client| !has_ended(&client.socket));
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
}

impl ServiceState {
    // An error of the connection means that the process has ended, or does not read and is killed:
    // the next one gets everything again.

    fn pass_model(&mut self, model: &ModelFile, file: &File) {
        self.pass(|control| control.add_model(model, file.as_fd()));
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
        models.iter().for_each(|(model, file)| self.pass_model(model, file));
        self.models = models;
        for client in clients {
            // It fails if the lambda's process has ended.
            if report_state(&client.socket, None).is_ok() {
                self.pass_client(&client);
                self.clients.push(client);
            }
        }
    }
}

/// The thread that starts the process and waits for its end.
struct Supervisor {
    program: PathBuf,
    shared: Arc<Shared>,
    /// The file in which the process notes the digests of models that it loads and runs.
    running: File,
    events: Events,
}

type StartError = Box<dyn std::error::Error + Send + Sync>;

impl Supervisor {
    fn supervise(mut self, child: Process) {
        let mut delay = RestartDelay::of_service();
        let mut current = Some(child);
        loop {
            let started = Instant::now();
            let mut is_killed = false;
            let reason = match current.take() {
                Some(child) => match self.wait(child) {
                    Ok(status) => {
                        is_killed = was_killed(status);
                        format!("{INFERENCE} ended unexpectedly ({status})")
                    }
                    Err(reason) => reason,
                },
                None => format!("{INFERENCE} could not be started"),
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
            state.clients.retain(|client| report_state(&client.socket, Some(&reason)).is_ok());
            if started.elapsed() >= HEALTHY {
                state.ends.retain(|digest, _| blamed.as_ref().is_some_and(|it| it.0 == *digest));
            }
            drop(state);
            let delay = delay.after(started.elapsed());
            // Not under the lock: the receiver may add a lambda before it reads this.
            (self.events)(InferenceEvent::Ended(reason, delay));
            let state = self.shared.lock();
            let waited = self.shared.stops.wait_timeout_while(state, delay, |state| !state.stops);
            if waited.unwrap_or_else(PoisonError::into_inner).0.stops {
                return;
            }
            match self.start() {
                Ok(child) => current = Some(child),
                Err(error) => {
                    let text = format!("cannot start {INFERENCE}: {}", chain(&*error));
                    (self.events)(InferenceEvent::Warning(text));
                }
            }
        }
    }

    /// Starts the process, and passes it all models and lambdas.
    fn start(&mut self) -> Result<Process, StartError> {
        let (control, process_end) = InferenceControl::pair()?;
        let (handover, stdin) = UnixStream::pair()?;
        let running = Some(self.running.try_clone()?.into());
        Handover { control: Some(process_end), running, ..Handover::default() }.send(&handover)?;
        let child = Command::new(&self.program)
            // Only `gleaner` receives Ctrl-C, and ends its processes in order.
            .process_group(0)
            .stdin(OwnedFd::from(stdin))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut process = Process { child, _handover: handover, readers: Vec::new() };
        let reader = || thread::Builder::new().name("inference output".to_owned());
        if let Some(reports) = process.child.stdout.take() {
            let events = Arc::clone(&self.events);
            process.readers.push(reader().spawn(move || follow(reports, &events))?);
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
            let state = self.shared.lock();
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
            let (model, _) = state.models.iter().find(|(model, _)| model.sha256 == digest)?;
            let text = format!("while it {what} `{}`", model.path);
            *state.ends.entry(digest.to_owned()).or_default() += u32::from(!is_killed);
            Some((digest.to_owned(), text))
        })
    }
}

/// A process that was started.
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

fn follow(reports: impl Read, events: &Events) {
    let mut reports = BufReader::new(reports);
    let mut line = Vec::new();
    while next_report(&mut reports, &mut line).unwrap_or(false) {
        match serde_json::from_slice(&line) {
            Ok(report) => events(InferenceEvent::Report(report)),
            Err(error) => {
                let text = format!("cannot parse a report of {INFERENCE}: {error}");
                events(InferenceEvent::Warning(text));
            }
        }
    }
}

/// Returns whether a signal of another process has ended it, which no model can send.
fn was_killed(status: ExitStatus) -> bool {
    let signal = status.signal().and_then(Signal::from_named_raw);
    matches!(signal, Some(Signal::KILL | Signal::TERM | Signal::INT | Signal::HUP))
}

/// Returns whether the lambda's process has closed its end of the connection.
fn has_ended(socket: &OwnedFd) -> bool {
    let mut polled = [PollFd::new(socket, PollFlags::empty())];
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut polled, Some(&now)).is_ok() && polled[0].revents().contains(PollFlags::HUP)
}

fn model_file(model: &ModelSpec) -> ModelFile {
    ModelFile { sha256: model.sha256.to_string(), path: model.file.to_string() }
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

/// Opens the file of a model in the build `build`.
fn open(model: &ModelSpec, build: &Path) -> Result<File, Failure> {
    let file = PlainFile::inside(build, model.file.as_path(), FILE_MAX).map(PlainFile::into_file);
    file.map_err(|error| {
        let message = format!("cannot open `{}`, the file of model `{}`", model.file, model.name);
        Failure::caused_by(Exit::Usage, message, &error)
            .with_help("build the lambda again: gleaner build DIR")
    })
}
