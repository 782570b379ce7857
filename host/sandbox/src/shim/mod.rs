//! `gleaner-shim [OPTIONS] -- PROGRAM ARGUMENTS...`: the parent of every runtime.
//!
//! It drops its own privileges, and so the runtime's, as far as no lambda's process needs them: the
//! runtime has no sockets but those that it inherits or receives. It passes on a small part of its
//! environment; kills the runtime when it misses the deadline of a call, is stopped, or takes too
//! much memory or too many threads; kills the processes that the runtime leaves behind; and writes
//! the exit record. It exits as the runtime did. The thread that does this allocates next to
//! nothing, and checks ten times a second.
//!
//! With `--results` a second thread writes the result files of the lambda, with `--spool` its
//! spool, so that the lambda's process cannot write any.
//!
//! It lives as long as its runtime, even if its starter ends; with `--starter` it then asks the
//! runtime to end.

mod compiler;
mod environment;
mod health_check;
mod orphans;
mod results;
mod signals;
mod watch;

use std::error::Error;
use std::ffi::OsString;
use std::io::PipeWriter;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode};
use std::time::Duration;

use clap::Parser;
use gleaner_base::{ByteSize, Exit, Failure};
use gleaner_protocol::process_stats::{HEARTBEAT_ENV, Heartbeat, make_inheritable};
use gleaner_protocol::{ExitRecord, LAYERS_ENV, Layer, ProcessOrigin, RESULTS_ENV, SHIM_ENV};

use self::results::{BUDGET, ResultFiles, ResultSpool, Results};
use self::signals::Signals;
use self::watch::RunningProcess;
use crate::cgroup::{CgroupLimits, Group};
use crate::{
    Paths, base_filter, cgroup, files, memory, needed, sandbox_filter, self_test, sockets,
};

/// Longest time until a runtime's first sign of life; compiling alone may take minutes on a small
/// machine.
const START: Duration = Duration::from_secs(900);

/// The name of the layer that this program implements.
const HARD_DEADLINE: &str = "hard deadline";

/// Starts a runtime in its jail, and watches it.
#[derive(Parser)]
#[command(name = "gleaner-shim", version = gleaner_base::version())]
struct Args {
    /// Write the exit record to this file; `-` writes it to standard output, as the last line.
    #[arg(long, value_name = "FILE")]
    exit_record: Option<PathBuf>,
    /// Write the results of a live lambda into this folder.
    #[arg(long, value_name = "DIR")]
    results: Option<PathBuf>,
    /// Append the results to those of an earlier process of the same run.
    #[arg(long, requires = "results")]
    again: bool,
    /// Write the results of a live lambda into the spool in this folder.
    #[arg(long, value_name = "DIR", requires = "origin", conflicts_with = "results")]
    spool: Option<PathBuf>,
    /// Deployment, revision and number of this start, as JSON, for the spool.
    #[arg(long, value_name = "JSON", requires = "spool")]
    origin: Option<ProcessOrigin>,
    /// Maximum size of the spool, in bytes; without it, 64 MiB.
    #[arg(long, value_name = "BYTES", requires = "spool")]
    spool_budget: Option<u64>,
    /// Ask the runtime to end when this process dies, which must be the parent of the shim.
    #[arg(long, value_name = "PID")]
    starter: Option<u32>,
    /// Create a control group for the runtime in this folder, which was delegated to this user.
    #[arg(long, value_name = "DIR")]
    cgroup: Option<PathBuf>,
    /// Memory limit of the control group, in bytes; a runtime lowers it to what its lambda needs.
    #[arg(long, value_name = "BYTES")]
    cgroup_memory: Option<u64>,
    /// Limit of processes and threads of the control group.
    #[arg(long, value_name = "N", default_value_t = 512)]
    cgroup_tasks: u64,
    /// Start the runtime also without a required layer, as WebAssembly confines its lambda.
    #[arg(long)]
    component: bool,
    /// Start nothing: set up every layer in this process, verify each, and print them as JSON.
    #[arg(long, conflicts_with = "program")]
    layers: bool,
    /// Start a compiler instead of a runtime, without sockets; refused if a layer of its jail does
    /// not hold.
    #[arg(
        long,
        requires = "write",
        conflicts_with_all = ["exit_record", "cgroup", "cgroup_memory", "layers"]
    )]
    compiler: bool,
    /// Path that a compiler may read, beside the system's programs and libraries.
    #[arg(long, value_name = "PATH", requires = "compiler")]
    read: Vec<PathBuf>,
    /// Path that a compiler may read and write.
    #[arg(long, value_name = "PATH", requires = "compiler")]
    write: Vec<PathBuf>,
    /// Let the compiler, which is then pip in the Python that is started, use the internet and all
    /// variables.
    #[arg(long, requires = "compiler")]
    network: bool,
    /// Run as the compiler's own process.
    #[arg(long, hide = true, requires = "compiler")]
    inside: bool,
    /// The runtime and its arguments.
    #[arg(last = true, required_unless_present = "layers")]
    program: Vec<OsString>,
}

pub fn main() -> ExitCode {
    let args = Args::parse();
    // Files that the starter happens to have open must not reach the lambda.
    let closed = gleaner_protocol::process_stats::close_on_exec()
        .map_err(cannot("cannot close files of the parent process"));
    let ended = closed.and_then(|()| match () {
        () if args.layers => show_layers(&args),
        () if args.inside => Err(compiler::enter(&args)),
        () => run(&args),
    });
    match ended {
        Ok(code) => code,
        Err(failure) => {
            eprintln!("{failure}");
            failure.exit.code().into()
        }
    }
}

/// Returns the conversion of an error that the user cannot mend; for `map_err`.
fn cannot<E: Error + 'static>(what: impl Into<String>) -> impl FnOnce(E) -> Failure {
    move |error| Failure::caused_by(Exit::Internal, what, &error)
}

fn run(args: &Args) -> Result<ExitCode, Failure> {
    refuse_without_required(args, needed::refused().as_slice())?;
    let signals = Signals::register().map_err(cannot("cannot register for signals"))?;
    if let Some(starter) = args.starter {
        end_with(starter)?;
    }
    if args.compiler {
        return compiler::run(args, signals);
    }
    orphans::adopt().map_err(cannot("cannot adopt the orphans of a runtime"))?;
    let (heartbeat, page) =
        Heartbeat::create().map_err(cannot("cannot create the heartbeat page"))?;
    // The runtime then finds an interpreter, compiles and attaches its topics, before its first
    // sign of life.
    heartbeat.alive(START);
    let number = make_inheritable(&page).map_err(cannot("cannot pass on the heartbeat page"))?;
    let mut layers = base_filter::apply();
    layers.extend([sockets::deny(), hard_deadline()]);
    let (group, layer) = create_cgroup(args);
    layers.push(layer);
    refuse_without_required(args, &layers)?;
    let layers = serde_json::to_string(&layers).expect("layers are plain data");
    let (program, arguments) = args.program.split_first().expect("clap requires a program");
    let mut command = Command::new(program);
    command.args(arguments).env_clear().envs(environment::for_runtime());
    command.env_remove(cgroup::CGROUP_ENV).env_remove(RESULTS_ENV);
    command.env(HEARTBEAT_ENV, number).env(LAYERS_ENV, layers);
    command.env(SHIM_ENV, std::process::id().to_string());
    if let Some(path) = args.exit_record.as_ref().filter(|path| path.as_os_str() != "-") {
        // Otherwise the record of an earlier runtime could be taken for this one's. Mostly there is
        // none.
        let _ = std::fs::remove_file(path);
    }
    let (results, pipe) = begin_results(args, &heartbeat)?.unzip();
    if let Some(pipe) = &pipe {
        let number = make_inheritable(pipe);
        command.env(RESULTS_ENV, number.map_err(cannot("cannot pass on the pipe for results"))?);
    }
    let started_ns = signals::time_of_day_ns();
    if let Some(group) = &group {
        let attached = group.attach(&mut command);
        attached.map_err(cannot("cannot attach the runtime to its control group"))?;
    }
    let child = start(&mut command)?;
    drop((page, pipe));
    let watched = RunningProcess { child, heartbeat, signals, group };
    let ended = watched.wait().map_err(cannot("cannot watch the runtime"))?;
    let orphans = orphans::kill_all();
    if orphans > 0 {
        eprintln!("gleaner-shim: killed {orphans} processes that the runtime left behind");
    }
    let record = ended.record(started_ns, orphans);
    write_record(args, &record);
    let written = results.map_or(Ok(()), |results| results.end().finish(&record));
    match written {
        // The runtime's exit code does not include this failure.
        Err(failure) if record.is_complete() => return Err(failure),
        Err(failure) => eprintln!("{failure}"),
        Ok(()) => {}
    }
    Ok(exit_like(&record))
}

/// Starts a runtime or a compiler.
fn start(command: &mut Command) -> Result<Child, Failure> {
    command.spawn().map_err(|error| {
        cannot(format!("cannot start `{}`", command.get_program().to_string_lossy()))(error)
    })
}

/// Writes the exit record, if it is wanted. The runtime's exit is more important than a failure.
fn write_record(args: &Args, record: &ExitRecord) {
    let Some(path) = &args.exit_record else { return };
    // A starter that has stopped reading does not need the record.
    let written =
        if path.as_os_str() == "-" { record.print().or(Ok(())) } else { record.write(path) };
    if let Err(error) = written {
        eprintln!("gleaner-shim: cannot write `{}`: {error}", path.display());
    }
}

/// Opens the results, if there are any, and returns the runtime's end of their pipe.
fn begin_results(
    args: &Args,
    heartbeat: &Heartbeat,
) -> Result<Option<(Results, PipeWriter)>, Failure> {
    if let Some(folder) = &args.results {
        let again = args.again;
        let open = move |folder: &Path| ResultFiles::open(folder, again);
        return Results::begin(folder, heartbeat, open).map(Some);
    }
    let Some((folder, origin)) = args.spool.as_ref().zip(args.origin.clone()) else {
        return Ok(None);
    };
    let budget = args.spool_budget.map_or(BUDGET, ByteSize::new);
    let open = move |folder: &Path| ResultSpool::open(folder, &origin, budget);
    Results::begin(folder, heartbeat, open).map(Some)
}

/// Requests SIGTERM for the death of `starter`. The kernel sends it once, so an earlier death is
/// checked here.
fn end_with(starter: u32) -> Result<(), Failure> {
    use rustix::process::{Signal, getppid, set_parent_process_death_signal};
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(cannot("cannot request a signal for the parent process's death"))?;
    let parent = getppid().map(|parent| parent.as_raw_nonzero().get().unsigned_abs());
    if parent == Some(starter) {
        return Ok(());
    }
    let help = "it may have ended; otherwise give `--starter` the number of the process that \
                starts gleaner-shim";
    let message = format!("process {starter} is not the parent of gleaner-shim");
    Err(Failure::new(Exit::Internal, message).with_help(help))
}

/// Ends this process as the runtime ended.
fn exit_like(record: &ExitRecord) -> ExitCode {
    // If the user can make the lambda fit, explain it, whichever process ended it.
    let help = match &record.killed {
        Some(killed) => Some(killed.help()),
        None => record.out_of_memory.then_some("keep less data, or raise `memory` in [limits]"),
    };
    if let Some((help, why)) = help.zip(record.sentence()) {
        let mut failure = Failure::new(Exit::LambdaFaulted, "the lambda was killed");
        failure.causes = vec![format!("its process {why}")];
        eprintln!("{}", failure.with_help(help));
        return Exit::LambdaFaulted.code().into();
    }
    if let Some(signal) = record.signal {
        signals::end_by(signal);
    }
    u8::try_from(record.code.unwrap_or(1)).unwrap_or(1).into()
}

/// Returns a failure if no lambda may run, as one of `layers` is missing; a component does, with a
/// warning.
fn refuse_without_required(args: &Args, layers: &[Layer]) -> Result<(), Failure> {
    let Some(missing) = layers.iter().find(|layer| layer.prevents_lambdas()) else { return Ok(()) };
    let Layer { name, note, .. } = missing;
    if args.component {
        eprintln!("warning: only WebAssembly confines the lambda: `{name}` does not hold: {note}");
        return Ok(());
    }
    let message = format!("this machine cannot sandbox a lambda: `{name}` does not hold");
    let failure = Failure::new(Exit::Internal, message);
    Err(Failure { causes: vec![note.clone()], ..failure }.with_help(missing.help()))
}

fn hard_deadline() -> Layer {
    Layer::yes(HARD_DEADLINE, "gleaner-shim kills a runtime that misses its deadline")
}

/// Creates the control group that was requested; returns its layer, too.
fn create_cgroup(args: &Args) -> (Option<Group>, Layer) {
    let Some(tree) = &args.cgroup else {
        return (None, Layer::no(cgroup::NAME, "not delegated: --cgroup DIR"));
    };
    let bounds = CgroupLimits { memory: args.cgroup_memory, tasks: args.cgroup_tasks };
    match Group::create(tree, &format!("gleaner-{}", std::process::id()), bounds) {
        Ok(group) => {
            let layer = group.layer();
            (Some(group), layer)
        }
        Err(why) => (None, Layer::no(cgroup::NAME, why)),
    }
}

/// Prints the layers that hold on this machine: each is set up in this process and verified.
fn show_layers(args: &Args) -> Result<ExitCode, Failure> {
    let mut layers = Vec::from_iter(needed::refused());
    layers.extend(base_filter::apply());
    layers.push(sockets::deny());
    let cannot_watch =
        |error: std::io::Error| Layer::no(HARD_DEADLINE, format!("no heartbeat page: {error}"));
    layers.push(Heartbeat::create().map_or_else(cannot_watch, |_| hard_deadline()));
    layers.push(create_cgroup(args).1);
    layers.push(files::confine(&Paths::default()));
    layers.push(sandbox_filter::apply_before_interpreter(true));
    layers.push(memory::limit(64 << 20));
    let denied =
        sandbox_filter::apply(true).unwrap_or_else(|error| sandbox_filter::missing(&error));
    layers.extend(denied.into_iter().filter(|layer| layer.name != sockets::NAME));
    let layers = self_test::verify(layers);
    println!("{}", serde_json::to_string(&layers).expect("layers are plain data"));
    Ok(ExitCode::SUCCESS)
}
