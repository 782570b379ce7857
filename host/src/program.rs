//! The program `gleaner-runtime`: reads its arguments, chooses the guest by the manifest's kind,
//! ends with an exit code.

use std::ffi::OsString;
use std::fs::File;
use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;

use clap::{Parser, Subcommand};
use gleaner_base::{Exit, Failure};
use gleaner_buffers::Pool;
#[cfg(feature = "python")]
use gleaner_jail::cgroup;
use gleaner_lambda::manifest::{Kind, Manifest};
use gleaner_transport::SampleMeta;
#[cfg(feature = "python")]
use rustix::process::Signal;

use crate::api::Session;
use crate::api::frame::Info;
use crate::check::{self, CheckArgs};
use crate::guest::Guest;
use crate::guest::watched::{Patience, Watched};
#[cfg(feature = "python")]
use crate::guest::worker::{NotReady, Remote};
use crate::guest::worker::{Reports, Sender};
use crate::input::live_slots;
#[cfg(feature = "python")]
use crate::isolation;
use crate::isolation::{Inside, Isolation, place_of_results};
#[cfg(feature = "dds")]
use crate::live;
#[cfg(feature = "python")]
use crate::replay::Packed;
use crate::replay::{self, InspectArgs, ReplayArgs, UnpackedArgs, VerifyArgs};
use crate::stage::{Asked, Bounds, Load};
#[cfg(feature = "dds")]
use crate::topics::TopicsArgs;

/// Hosts one lambda. Writes reports, a JSON object a line, to standard output.
#[derive(Parser)]
#[command(name = "gleaner-runtime", version)]
struct Cli {
    /// Runs the lambda of a replay, sends each outcome to the process that started this one, and
    /// writes nothing.
    #[arg(long, hide = true)]
    worker: bool,
    #[command(flatten)]
    unpacked: UnpackedArgs,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Runs a built lambda over recorded drives.
    Replay(ReplayArgs),
    /// Makes the decisions in a clip again and compares.
    Verify(VerifyArgs),
    /// Runs the `init` of a built lambda, and reports what it will need.
    Check(CheckArgs),
    /// Reports what is in recorded drives.
    Inspect(InspectArgs),
    /// Runs a built lambda on live topics, until SIGTERM.
    #[cfg(feature = "dds")]
    Run(live::RunArgs),
    /// Reports the topics that are there.
    #[cfg(feature = "dds")]
    Topics(TopicsArgs),
}

/// A task with a lambda. There is one in a process, so that its size matters little.
#[allow(clippy::large_enum_variant)]
enum Job {
    Replay(replay::Job),
    Check(check::Job),
    #[cfg(feature = "dds")]
    Live(live::Job),
}

impl Job {
    fn lambda(&self) -> (&Asked, &Manifest) {
        match self {
            Self::Replay(job) => (&job.options.asked, &job.manifest),
            Self::Check(job) => (&job.asked, &job.manifest),
            #[cfg(feature = "dds")]
            Self::Live(job) => (&job.asked, &job.manifest),
        }
    }

    /// What a process needs from its start: the place of its results, which is made, and memory for
    /// itself and its rings.
    fn around(&self, is_worker: bool) -> Result<Inside, Failure> {
        let results = match self {
            _ if is_worker => None,
            Self::Replay(job) => {
                job.make_journal()?;
                job.results()
            }
            Self::Check(_) => None,
            // Another process writes them.
            #[cfg(feature = "dds")]
            Self::Live(_) => None,
        };
        let mut inside = self.inside(is_worker);
        if let Some(folder) = results {
            inside.paths.write.push(place_of_results(folder, &self.lambda().0.lambda)?);
        }
        inside.memory = inside.memory.map(|more| more.saturating_add(at_start(self.lambda().1)));
        Ok(inside)
    }

    /// Returns the permissions of the process after the lambda is loaded. A worker writes nothing.
    fn inside(&self, is_worker: bool) -> Inside {
        let (mut paths, ours) = match self {
            Self::Replay(job) => (job.paths(), job.own_memory()),
            Self::Check(job) => (job.paths(), 0),
            #[cfg(feature = "dds")]
            Self::Live(job) => (job.paths(), job.own_memory()),
        };
        if is_worker {
            paths.write.clear();
        }
        let manifest = self.lambda().1;
        // What grows in place may be there twice for a moment.
        let kept = 2 * manifest.limits.scratch.bytes();
        let memory = manifest.limits.memory.bytes().saturating_add(kept).saturating_add(ours);
        // Frames that a lambda makes may take `memory` once more.
        let all = memory
            .saturating_add(manifest.limits.memory.bytes())
            .saturating_add(at_start(manifest));
        Inside { paths, memory: (manifest.lambda.kind == Kind::Python).then_some(memory), all }
    }

    /// Returns whether the job is a live run. If not, a Python lambda runs in a worker.
    #[cfg(feature = "python")]
    fn is_live(&self) -> bool {
        match self {
            Self::Replay(_) | Self::Check(_) => false,
            #[cfg(feature = "dds")]
            Self::Live(_) => true,
        }
    }

    /// Does what is not live, with guests in this process or in a worker.
    fn run_offline(self, load: Load<'_>, reports: &mut dyn Write) -> Result<Exit, Failure> {
        match self {
            Self::Replay(job) => job.run(load, reports),
            Self::Check(job) => job.run(load, reports),
            #[cfg(feature = "dds")]
            Self::Live(_) => Err(no_worker()),
        }
    }

    fn work(self, load: Load<'_>, reports: &mut Reports) -> Result<Exit, Failure> {
        match self {
            Self::Replay(job) => job.work(load, reports),
            Self::Check(job) => job.run(load, reports),
            #[cfg(feature = "dds")]
            Self::Live(_) => Err(no_worker()),
        }
    }
}

#[cfg(feature = "dds")]
fn no_worker() -> Failure {
    Failure::new(Exit::Usage, "a live run has no worker").with_help("leave `--worker` out")
}

/// Memory that a process takes before the lambda is in it, at most: an interpreter with numpy and
/// our own part take some 100 MB, and numpy's threads more where a user asks for many; and the
/// rings.
fn at_start(manifest: &Manifest) -> u64 {
    const INTERPRETER: u64 = 1 << 30;
    let rings = manifest.inputs.iter().flat_map(|input| {
        let decoded = input.decoded_size.map(|bytes| (input.decoded_slots(), bytes.as_usize()));
        let decoded = decoded.and_then(|(slots, bytes)| Pool::<Info>::bytes_needed(slots, bytes));
        [Pool::<SampleMeta>::bytes_needed(live_slots(input), input.max_size.as_usize()), decoded]
    });
    rings.flatten().fold(INTERPRETER, |sum, bytes| sum.saturating_add(bytes as u64))
}

impl Cli {
    /// The job, or how it ended where no lambda is needed for it.
    fn job(self) -> Result<Result<Job, Exit>, Failure> {
        let Self { unpacked, command, .. } = self;
        let mut job = command.job()?;
        if let Ok(Job::Replay(job)) = &mut job {
            job.take(unpacked)?;
        }
        Ok(job)
    }
}

impl Command {
    /// The job, or how it ended where no lambda is needed for it.
    fn job(self) -> Result<Result<Job, Exit>, Failure> {
        Ok(match self {
            Self::Replay(args) => Ok(Job::Replay(replay::Job::replay(args)?)),
            Self::Verify(args) => Ok(Job::Replay(replay::Job::verify(args)?)),
            Self::Check(args) => Ok(Job::Check(check::Job::new(args)?)),
            Self::Inspect(args) => Err(replay::inspect(&args, &mut reports()?)?),
            #[cfg(feature = "dds")]
            Self::Run(args) => Ok(Job::Live(live::Job::new(args)?)),
            #[cfg(feature = "dds")]
            Self::Topics(args) => Err(crate::topics::run(args, &mut reports()?)?),
        })
    }
}

/// `main` of `gleaner-runtime`.
pub fn main() -> ExitCode {
    prepare();
    let cli = Cli::parse();
    let worker = cli.worker;
    end(cli.job().and_then(|job| job.map_or_else(Ok, |job| run_any(job, worker))))
}

/// What `_gleaner` does inside the interpreter, with the arguments that `gleaner-runtime` was
/// given: their job, with the guest that `load` makes. Returns the exit code.
pub fn run_in_python(args: Vec<OsString>, load: Load<'_>) -> u8 {
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

fn run_any(job: Job, is_worker: bool) -> Result<Exit, Failure> {
    #[allow(unused_variables, reason = "the folder is looked at only where Python can be hosted")]
    let (asked, manifest) = job.lambda();
    #[allow(unused_variables, reason = "the same")]
    let around = job.around(is_worker)?;
    match manifest.lambda.kind {
        #[cfg(feature = "wasm")]
        Kind::Wasm => run(job, &mut wasm::load),
        #[cfg(feature = "python")]
        Kind::Python if !is_worker && !job.is_live() => run_with_worker(job),
        #[cfg(feature = "python")]
        Kind::Python => {
            let args = std::env::args_os().collect::<Vec<_>>();
            let error = crate::guest::python::become_interpreter(&asked.lambda, &args, around);
            Err(Failure::because(format!("cannot start lambda `{}`", manifest.lambda.name), &error))
        }
        #[allow(unreachable_patterns)]
        kind => Err(Failure::new(
            Exit::Usage,
            format!("this gleaner-runtime was built without lambdas of kind {}", kind.as_str()),
        )),
    }
}

/// Does `job` but for what its worker does.
#[cfg(feature = "python")]
fn run_with_worker(job: Job) -> Result<Exit, Failure> {
    isolation::end_with_starter(Signal::TERM)?;
    // The group of this process is that of its worker, too.
    let group = cgroup::fit(job.inside(false).all);
    let packed = if let Job::Replay(job) = &job { Some(job.packed()) } else { None };
    let mut explained = None;
    let mut remote = |_: &Asked, manifest: &Manifest, session, _| {
        let lent = packed.as_ref().map(Packed::lend).transpose()?;
        let arguments = lent.iter().flat_map(|lent| lent.arguments.clone()).collect();
        // When it is ready it has opened its drives.
        match Remote::start(arguments, manifest, session, group.clone()) {
            Ok(guest) => Ok(Box::new(guest) as _),
            Err(NotReady::Failed(failure)) => Err(failure),
            Err(NotReady::Explained(exit)) => {
                explained = Some(exit);
                Err(Failure::new(exit, "the lambda's process could not start"))
            }
        }
    };
    let ended = job.run_offline(&mut remote, &mut reports()?);
    explained.map_or(ended, Ok)
}

fn run(job: Job, load: Load<'_>) -> Result<Exit, Failure> {
    let isolation = Arc::new(Isolation::of_this_process(job.inside(false))?);
    let mut watched = watched(load, &isolation);
    match job {
        #[cfg(feature = "dds")]
        Job::Live(job) => job.run(&mut watched, &isolation, reports()?),
        job => job.run_offline(&mut watched, &mut reports()?),
    }
}

/// Does the part of `job` that is the worker's. Once the lambda may have run, what goes wrong is no
/// longer printed: the process that reads the outcomes finds it too, and nothing here is to be
/// taken for its words.
fn work(job: Job, load: Load<'_>) -> Result<Exit, Failure> {
    let isolation = Arc::new(Isolation::of_this_process(job.inside(true))?);
    let reports = Reports::to(reports()?);
    let mut watched = watched(load, &isolation);
    let mut sending = |asked: &Asked, manifest: &Manifest, session: Session, bounds| {
        let guest: Box<dyn Guest> = watched(asked, manifest, session.clone(), bounds)?;
        let layers = guest.layers()?;
        Ok(Box::new(Sender::begin(guest, session, reports.clone(), layers)) as _)
    };
    let ended = job.work(&mut sending, &mut reports.clone());
    if reports.is_ready() { Ok(ended.unwrap_or(Exit::Ok)) } else { ended }
}

/// Has the guests that `load` makes entered only once this process is sandboxed.
fn watched<'a>(
    load: Load<'a>,
    isolation: &'a Arc<Isolation>,
) -> impl FnMut(&Asked, &Manifest, Session, Bounds) -> Result<Box<dyn Guest>, Failure> + 'a {
    move |asked, manifest, session, bounds| {
        let limits = &manifest.limits;
        let patience = match bounds {
            Bounds::Replay => Patience::replay(limits.init_deadline, limits.deadline),
            Bounds::Live(deadline) => Patience::live(limits.init_deadline, deadline),
        };
        // A component's is counted as it grows.
        let memory = (manifest.lambda.kind == Kind::Python).then_some(limits.memory.bytes());
        let guest = load(asked, manifest, session, bounds)?;
        Ok(Box::new(Watched::new(guest, Arc::clone(isolation), patience, memory)) as _)
    }
}

/// See [`gleaner_vitals::start::reports`].
fn reports() -> Result<File, Failure> {
    gleaner_vitals::start::reports().map_err(|error| {
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
    use crate::stage::{Asked, Bounds};

    pub(super) fn load(
        asked: &Asked,
        manifest: &Manifest,
        session: Session,
        bounds: Bounds,
    ) -> Result<Box<dyn Guest>, Failure> {
        let cannot = |error: &WasmError| {
            Failure::because(format!("cannot load lambda `{}`", manifest.lambda.name), error)
        };
        let cache = gleaner_parts::cache_dir().map_err(|error| cannot(&error.into()))?;
        let limits = &manifest.limits;
        let nans = if manifest.lambda.deterministic { Nans::Canonical } else { Nans::AsMade };
        let loaded =
            Loaded::open(&asked.build.entry_path(manifest), &cache, limits.stack.as_usize(), nans)
                .map_err(|error| cannot(&error))?;
        let failed = |error: std::io::Error| {
            Failure::caused_by(Exit::Internal, "cannot make a guest", &error)
        };
        let deadline = match bounds {
            Bounds::Replay => None,
            Bounds::Live(allowed) => Some(
                Deadline::new(loaded.engine(), allowed.min(limits.init_deadline))
                    .map_err(failed)?,
            ),
        };
        let guest = WasmGuest::new(loaded, session, limits, deadline).map_err(failed)?;
        Ok(Box::new(guest))
    }
}

fn prepare() {
    crate::memory::give_large_blocks_back();
    gleaner_vitals::log::prepare();
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
