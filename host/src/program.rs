//! The program `gleaner-runtime`: parses its arguments, chooses the guest by the manifest's kind,
//! and ends with an exit code.

use std::ffi::OsString;
use std::fs::File;
use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;

use clap::{Parser, Subcommand};
use gleaner_base::{Exit, Failure};
use gleaner_buffers::Pool;
use gleaner_lambda::manifest::{LambdaKind, Manifest};
use gleaner_messages::transport::StoredMeta;
#[cfg(feature = "python")]
use gleaner_sandbox::cgroup;
#[cfg(feature = "python")]
use rustix::process::Signal;

use crate::api::Session;
use crate::api::frame::Info;
use crate::check::{self, CheckArgs};
use crate::guest::Guest;
use crate::guest::sandboxed::{KillTimeouts, SandboxedGuest};
use crate::guest::worker::{MessageSender, SendingGuest};
#[cfg(feature = "python")]
use crate::guest::worker::{RemoteGuest, WorkerStartError};
#[cfg(feature = "python")]
use crate::isolation;
use crate::isolation::{Isolation, SandboxPermissions, create_results_dir};
use crate::live;
#[cfg(feature = "python")]
use crate::replay::Packed;
use crate::replay::{self, InspectArgs, ReplayArgs, UnpackedArgs, VerifyArgs};
use crate::session_setup::{ConfiguredLambda, Load, RunMode};

/// Hosts one lambda. Writes reports, a JSON object a line, to standard output.
#[derive(Parser)]
#[command(name = "gleaner-runtime", version = gleaner_base::version())]
struct Cli {
    /// Runs the lambda of a replay, sends each outcome to the process that started this one, and
    /// writes nothing.
    #[arg(long, hide = true)]
    worker: bool,
    #[command(flatten)]
    unpacked: UnpackedArgs,
    #[command(subcommand)]
    command: RuntimeCommand,
}

#[derive(Subcommand)]
enum RuntimeCommand {
    /// Runs a built lambda over recorded drives.
    Replay(ReplayArgs),
    /// Reproduces the decisions in a clip and compares.
    Verify(VerifyArgs),
    /// Runs the `init` of a built lambda, and reports what it will need.
    Check(CheckArgs),
    /// Reports the content of recorded drives.
    Inspect(InspectArgs),
    /// Runs a built lambda on live topics, until SIGTERM.
    Run(live::RunArgs),
}

/// A task with a lambda. A process has one, so that its size matters little.
#[allow(clippy::large_enum_variant)]
enum RuntimeJob {
    Replay(replay::ReplayJob),
    Check(check::CheckJob),
    Live(live::LiveJob),
}

impl RuntimeJob {
    fn lambda(&self) -> (&ConfiguredLambda, &Manifest) {
        match self {
            Self::Replay(job) => (&job.options.lambda, &job.manifest),
            Self::Check(job) => (&job.lambda, &job.manifest),
            Self::Live(job) => (&job.lambda, &job.manifest),
        }
    }

    /// Connects to the process that runs models, if the starter has passed a connection. A live run
    /// receives it with its others.
    fn connect_models(&mut self) -> Result<(), Failure> {
        match self {
            Self::Replay(job) => job.options.lambda.connect_models(&job.manifest),
            Self::Check(job) => job.lambda.connect_models(&job.manifest),
            Self::Live(_) => Ok(()),
        }
    }

    /// Returns the permissions that a process needs from its start on: the folder of its results,
    /// which is created, and memory for itself and its rings.
    fn start_permissions(&self, is_worker: bool) -> Result<SandboxPermissions, Failure> {
        let results = match self {
            _ if is_worker => None,
            Self::Replay(job) => {
                job.make_journal()?;
                job.results()
            }
            Self::Check(_) => None,
            // Another process writes them.
            Self::Live(_) => None,
        };
        let mut permissions = self.permissions(is_worker);
        if let Some(folder) = results {
            permissions.paths.write.push(create_results_dir(folder, &self.lambda().0.folder)?);
        }
        permissions.memory = permissions
            .memory
            .map(|more| more.saturating_add(at_start(self.lambda().1, self.is_live())));
        Ok(permissions)
    }

    /// Returns the permissions of the process after the lambda is loaded. A worker writes nothing.
    fn permissions(&self, is_worker: bool) -> SandboxPermissions {
        let (mut paths, own_memory) = match self {
            Self::Replay(job) => (job.paths(), job.own_memory()),
            Self::Check(job) => (job.paths(), 0),
            Self::Live(job) => (job.paths(), job.own_memory()),
        };
        if is_worker {
            paths.write.clear();
        }
        let manifest = self.lambda().1;
        // An entry that grows may exist twice for a moment.
        let kept = 2 * manifest.limits.scratch.bytes();
        let memory = manifest.limits.memory.bytes().saturating_add(kept).saturating_add(own_memory);
        // Frames that a lambda creates may take `memory` again.
        let all = memory
            .saturating_add(manifest.limits.memory.bytes())
            .saturating_add(at_start(manifest, self.is_live()));
        SandboxPermissions {
            paths,
            memory: (manifest.lambda.kind == LambdaKind::Python).then_some(memory),
            all,
        }
    }

    /// Returns whether the job is a live run. If not, a Python lambda runs in a worker.
    fn is_live(&self) -> bool {
        match self {
            Self::Replay(_) | Self::Check(_) => false,
            Self::Live(_) => true,
        }
    }

    /// Runs a job that is not live, with guests in this process or in a worker.
    fn run_offline(self, load: Load<'_>, reports: &mut dyn Write) -> Result<Exit, Failure> {
        match self {
            Self::Replay(job) => job.run(load, reports),
            Self::Check(job) => job.run(load, reports),
            Self::Live(_) => Err(no_worker()),
        }
    }

    fn work(self, load: Load<'_>, reports: &mut MessageSender) -> Result<Exit, Failure> {
        match self {
            Self::Replay(job) => job.work(load, reports),
            Self::Check(job) => job.run(load, reports),
            Self::Live(_) => Err(no_worker()),
        }
    }
}

fn no_worker() -> Failure {
    Failure::new(Exit::Usage, "a live run has no worker").with_help("leave `--worker` out")
}

/// Upper bound of the memory in bytes that a process uses before the lambda is loaded: the rings
/// that it fills itself, decoded images, and an interpreter with numpy and Gleaner's own code,
/// which take some 100 MB, or more if the user requests many threads of numpy.
fn at_start(manifest: &Manifest, is_live: bool) -> u64 {
    const INTERPRETER: u64 = 1 << 30;
    let rings = manifest.inputs.iter().flat_map(|input| {
        let decoded = input.decoded_size.map(|bytes| (input.decoded_slots(), bytes.as_usize()));
        let decoded = decoded.and_then(|(slots, bytes)| Pool::<Info>::bytes_needed(slots, bytes));
        let bytes = input.max_size.as_usize();
        let samples = (!is_live).then(|| Pool::<StoredMeta>::bytes_needed(input.slots(), bytes));
        [samples.flatten(), decoded]
    });
    rings.flatten().fold(INTERPRETER, |sum, bytes| sum.saturating_add(bytes as u64))
}

impl Cli {
    /// Returns the job, or the exit of a command that needs no lambda.
    /// Returns the job, or the exit of a command that needs no lambda.
    fn job(self) -> Result<Result<RuntimeJob, Exit>, Failure> {
        let Self { unpacked, command, .. } = self;
        let mut job = command.job()?;
        if let Ok(RuntimeJob::Replay(job)) = &mut job {
            job.use_unpacked(unpacked)?;
        }
        Ok(job)
    }
}

impl RuntimeCommand {
    fn job(self) -> Result<Result<RuntimeJob, Exit>, Failure> {
        Ok(match self {
            Self::Replay(args) => Ok(RuntimeJob::Replay(replay::ReplayJob::replay(args)?)),
            Self::Verify(args) => Ok(RuntimeJob::Replay(replay::ReplayJob::verify(args)?)),
            Self::Check(args) => Ok(RuntimeJob::Check(check::CheckJob::new(args)?)),
            Self::Inspect(args) => Err(replay::inspect(&args, &mut reports()?)?),
            Self::Run(args) => Ok(RuntimeJob::Live(live::LiveJob::new(args)?)),
        })
    }
}

pub fn main() -> ExitCode {
    prepare();
    let cli = Cli::parse();
    let worker = cli.worker;
    end(cli.job().and_then(|job| job.map_or_else(Ok, |job| run_any(job, worker))))
}

/// Runs the job with the arguments of `gleaner-runtime` and the guest that `load` creates: for
/// `_gleaner`, inside the interpreter, and for benches. Returns the exit code.
pub fn run_with(args: Vec<OsString>, load: Load<'_>) -> u8 {
    prepare();
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(error) => {
            let _ = error.print();
            return Exit::Usage.code();
        }
    };
    let worker = cli.worker;
    code(cli.job().and_then(|job| {
        job.map_or_else(Ok, |job| if worker { work(job, load) } else { run(job, load) })
    }))
}

fn run_any(job: RuntimeJob, is_worker: bool) -> Result<Exit, Failure> {
    #[allow(unused_variables, reason = "used only with the feature `python`")]
    let (lambda, manifest) = job.lambda();
    #[allow(unused_variables, reason = "the same")]
    let permissions = job.start_permissions(is_worker)?;
    match manifest.lambda.kind {
        #[cfg(feature = "wasm")]
        LambdaKind::Wasm => run(job, &mut wasm::load),
        #[cfg(feature = "python")]
        LambdaKind::Python if !is_worker && !job.is_live() => run_with_worker(job),
        #[cfg(feature = "python")]
        LambdaKind::Python => {
            let args = std::env::args_os().collect::<Vec<_>>();
            let error =
                crate::guest::python::become_interpreter(&lambda.folder, &args, permissions);
            Err(Failure::because(format!("cannot start lambda `{}`", manifest.lambda.name), &error))
        }
        #[allow(unreachable_patterns)]
        kind => Err(Failure::new(
            Exit::Usage,
            format!("this gleaner-runtime was built without lambdas of kind {}", kind.as_str()),
        )),
    }
}

/// Runs `job` except for the part that its worker runs.
#[cfg(feature = "python")]
fn run_with_worker(job: RuntimeJob) -> Result<Exit, Failure> {
    isolation::die_with_parent(Signal::TERM)?;
    // The worker is in the control group of this process.
    let group = cgroup::limit_memory(job.permissions(false).all);
    let packed = if let RuntimeJob::Replay(job) = &job { Some(job.packed()) } else { None };
    let mut explained = None;
    let mut remote = |_: &ConfiguredLambda, manifest: &Manifest, session, _| {
        let contents = packed.as_ref().map(Packed::unpack_for_worker).transpose()?;
        let arguments = contents.iter().flat_map(|contents| contents.arguments.clone()).collect();
        // A worker that is ready has opened its drives.
        match RemoteGuest::start(arguments, manifest, session, group.clone()) {
            Ok(guest) => Ok(Box::new(guest) as _),
            Err(WorkerStartError::Failed(failure)) => Err(failure),
            Err(WorkerStartError::Explained(exit)) => {
                explained = Some(exit);
                Err(Failure::new(exit, "the lambda's process could not start"))
            }
        }
    };
    let ended = job.run_offline(&mut remote, &mut reports()?);
    explained.map_or(ended, Ok)
}

fn run(mut job: RuntimeJob, load: Load<'_>) -> Result<Exit, Failure> {
    job.connect_models()?;
    let isolation = Arc::new(Isolation::of_this_process(job.permissions(false))?);
    let mut sandboxed = sandboxed(load, &isolation);
    match job {
        RuntimeJob::Live(job) => job.run(&mut sandboxed, &isolation, reports()?),
        job => job.run_offline(&mut sandboxed, &mut reports()?),
    }
}

/// Runs the worker's part of `job`. Once the lambda may have run, errors are no longer printed: the
/// process that reads the outcomes finds them too, and must not trust this one's output.
fn work(mut job: RuntimeJob, load: Load<'_>) -> Result<Exit, Failure> {
    job.connect_models()?;
    let isolation = Arc::new(Isolation::of_this_process(job.permissions(true))?);
    let reports = MessageSender::to(reports()?);
    let mut sandboxed = sandboxed(load, &isolation);
    let mut sending = |lambda: &ConfiguredLambda, manifest: &Manifest, session: Session, mode| {
        let guest: Box<dyn Guest> = sandboxed(lambda, manifest, session.clone(), mode)?;
        let layers = guest.layers()?;
        Ok(Box::new(SendingGuest::begin(guest, session, reports.clone(), layers)) as _)
    };
    let ended = job.work(&mut sending, &mut reports.clone());
    if reports.is_ready() { Ok(ended.unwrap_or(Exit::Ok)) } else { ended }
}

/// A loaded guest, or the reason why there is none.
type GuestResult = Result<Box<dyn Guest>, Failure>;

/// Wraps the guests that `load` creates: the process is sandboxed before the first call.
fn sandboxed<'a>(
    load: Load<'a>,
    isolation: &'a Arc<Isolation>,
) -> impl FnMut(&ConfiguredLambda, &Manifest, Session, RunMode) -> GuestResult + 'a {
    move |lambda, manifest, session, mode| {
        let limits = &manifest.limits;
        let timeouts = match mode {
            RunMode::Replay => KillTimeouts::replay(limits.init_deadline, limits.deadline),
            RunMode::Live(deadline) => KillTimeouts::live(limits.init_deadline, deadline),
        };
        // The memory of a component is counted as it grows.
        let memory = (manifest.lambda.kind == LambdaKind::Python).then_some(limits.memory.bytes());
        let models = session.models().clone();
        let guest = load(lambda, manifest, session, mode)?;
        let isolation = Arc::clone(isolation);
        Ok(Box::new(SandboxedGuest::new(guest, isolation, timeouts, memory, models)) as _)
    }
}

/// See [`gleaner_protocol::process_stats::start::reports`].
fn reports() -> Result<File, Failure> {
    gleaner_protocol::process_stats::start::reports().map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot set up the report stream", &error)
    })
}

#[cfg(feature = "wasm")]
mod wasm {
    use gleaner_base::{Exit, Failure};
    use gleaner_compile::Nans;
    use gleaner_lambda::manifest::Manifest;

    use crate::api::Session;
    use crate::guest::Guest;
    use crate::guest::wasm::{Deadline, Loaded, WasmError, WasmGuest};
    use crate::session_setup::{ConfiguredLambda, RunMode};

    pub(super) fn load(
        lambda: &ConfiguredLambda,
        manifest: &Manifest,
        session: Session,
        mode: RunMode,
    ) -> Result<Box<dyn Guest>, Failure> {
        let cannot = |error: &WasmError| {
            Failure::because(format!("cannot load lambda `{}`", manifest.lambda.name), error)
        };
        let cache = gleaner_base::programs::cache_dir().map_err(|error| cannot(&error.into()))?;
        let limits = &manifest.limits;
        let nans = if manifest.lambda.deterministic { Nans::Canonical } else { Nans::Native };
        let loaded =
            Loaded::open(&lambda.build.entry_path(manifest), &cache, limits.stack.as_usize(), nans)
                .map_err(|error| cannot(&error))?;
        let failed = |error: std::io::Error| {
            Failure::caused_by(Exit::Internal, "cannot create a guest", &error)
        };
        let deadline = match mode {
            RunMode::Replay => None,
            RunMode::Live(allowed) => Some(
                Deadline::new(loaded.engine(), allowed.min(limits.init_deadline))
                    .map_err(failed)?,
            ),
        };
        let guest = WasmGuest::new(loaded, session, limits, deadline).map_err(failed)?;
        Ok(Box::new(guest))
    }
}

fn prepare() {
    crate::memory::map_large_blocks();
    gleaner_protocol::process_stats::log::init();
}

fn end(result: Result<Exit, Failure>) -> ExitCode {
    code(result).into()
}

fn code(result: Result<Exit, Failure>) -> u8 {
    match result {
        Ok(exit) => exit.code(),
        Err(failure) => {
            eprintln!("{failure}");
            failure.exit.code()
        }
    }
}
