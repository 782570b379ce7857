//! `gleaner-shim [OPTIONS] -- PROGRAM ARGUMENTS...`: the parent of every runtime, whoever wants it
//! started.
//!
//! It takes from itself, and so from the runtime, what no lambda's process needs; hands on a small
//! part of its environment; kills the runtime when it does not come back from a lambda in time, is
//! stopped, or takes more memory or threads than it may; ends what the runtime left behind; and
//! writes down how it ended. Its own exit is that of the runtime. The thread that does so allocates
//! next to nothing, and looks ten times a second.
//!
//! With `--results` a second thread writes the files of the lambda's results, so that the process
//! of the lambda can write none.
//!
//! It lives as long as its runtime, even if whoever started it goes away; with `--starter` it then
//! asks the runtime to end.

mod compiler;
mod environment;
mod lines;
mod look;
mod orphans;
mod results;
mod signals;
mod watch;

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::{Command, ExitCode};
use std::time::Duration;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_jail::cgroup::{Bounds, Group};
use gleaner_jail::{Paths, alone, cgroup, files, memory, never, tried};
use gleaner_protocol::{ExitRecord, LAYERS_ENV, Layer, RESULTS_ENV};
use gleaner_vitals::{PULSE_ENV, Pulse, hand_on};

use self::results::Results;
use self::signals::Signals;
use self::watch::Watched;

/// How long a runtime may take until it gives a sign of life; compiling alone may take minutes on a
/// small machine.
const START: Duration = Duration::from_secs(900);

/// The name of the layer that is this program.
const HARD_DEADLINE: &str = "hard deadline";

/// Starts a runtime in its jail, and watches over it.
#[derive(Parser)]
#[command(name = "gleaner-shim", version)]
struct Args {
    /// Write down here how it ended; `-` is for standard output, as the last line.
    #[arg(long, value_name = "FILE")]
    exit_record: Option<PathBuf>,
    /// Write the results of a live lambda into this folder.
    #[arg(long, value_name = "DIR")]
    results: Option<PathBuf>,
    /// Add them to those that are there, of an earlier process of the same run.
    #[arg(long, requires = "results")]
    again: bool,
    /// Ask it to end when this process dies, which started this shim.
    #[arg(long, value_name = "PID")]
    starter: Option<u32>,
    /// Give it a control group of its own in this folder, which was delegated to this user.
    #[arg(long, value_name = "DIR")]
    cgroup: Option<PathBuf>,
    /// Most memory of the control group, in bytes; a runtime makes it as small as its lambda
    /// allows.
    #[arg(long, value_name = "BYTES")]
    cgroup_memory: Option<u64>,
    /// Most processes and threads of the control group.
    #[arg(long, value_name = "N", default_value_t = 512)]
    cgroup_tasks: u64,
    /// Start nothing: set up every layer here, try each, and write what holds, as JSON.
    #[arg(long, conflicts_with = "program")]
    layers: bool,
    /// Start a compiler instead of a runtime, without sockets; refused where a layer of its jail
    /// does not hold.
    #[arg(long, requires = "write", conflicts_with_all = ["exit_record", "cgroup", "cgroup_memory", "layers"])]
    compiler: bool,
    /// What a compiler may read beside the system's programs and libraries.
    #[arg(long, value_name = "PATH", requires = "compiler")]
    read: Vec<PathBuf>,
    /// What a compiler may read and write.
    #[arg(long, value_name = "PATH", requires = "compiler")]
    write: Vec<PathBuf>,
    /// Be the compiler's own process.
    #[arg(long, hide = true, requires = "compiler")]
    inside: bool,
    /// The runtime and its arguments.
    #[arg(last = true, required_unless_present = "layers")]
    program: Vec<OsString>,
}

/// `main` of `gleaner-shim`.
pub fn main() -> ExitCode {
    let args = Args::parse();
    // Files that the starter happened to have open are none of the lambda's.
    let closed = gleaner_vitals::close_on_exec().map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot close files of the starter", &error)
    });
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

fn run(args: &Args) -> Result<ExitCode, Failure> {
    let cannot =
        |what: &str, error: &dyn std::error::Error| Failure::caused_by(Exit::Internal, what, error);
    let signals = Signals::hear().map_err(|error| cannot("cannot listen for signals", &error))?;
    if let Some(starter) = args.starter {
        end_with(starter)?;
    }
    if args.compiler {
        return compiler::run(args, signals);
    }
    orphans::adopt()
        .map_err(|error| cannot("cannot adopt what a runtime leaves behind", &error))?;
    let (pulse, page) =
        Pulse::make().map_err(|error| cannot("cannot make a page for the pulse", &error))?;
    // Finding an interpreter, compiling, discovery: until the first word of its own.
    pulse.alive(START);
    let number = hand_on(&page).map_err(|error| cannot("cannot hand on the pulse", &error))?;
    let mut layers = never::forbid();
    layers.push(hard_deadline());
    let (group, layer) = own_group(args);
    layers.push(layer);
    let layers = serde_json::to_string(&layers).expect("layers are plain data");
    let (program, arguments) = args.program.split_first().expect("clap asks for a program");
    let mut command = Command::new(program);
    command
        .args(arguments)
        .env_clear()
        .envs(environment::handed_on())
        .env_remove(cgroup::CGROUP_ENV);
    command.env(PULSE_ENV, number).env(LAYERS_ENV, layers).env_remove(RESULTS_ENV);
    if let Some(path) = args.exit_record.as_ref().filter(|path| path.as_os_str() != "-") {
        // Else the end of an earlier one could be taken for that of this one. Mostly there is none.
        let _ = std::fs::remove_file(path);
    }
    let begun = args
        .results
        .as_ref()
        .map(|folder| Results::begin(folder, args.again, &pulse))
        .transpose()?;
    let (results, pipe) = begun.unzip();
    if let Some(pipe) = &pipe {
        command.env(
            RESULTS_ENV,
            hand_on(pipe).map_err(|error| cannot("cannot hand on the results' pipe", &error))?,
        );
    }
    let started_ns = signals::time_of_day_ns();
    if let Some(group) = &group {
        group
            .holds(&mut command)
            .map_err(|error| cannot("cannot have the runtime in its control group", &error))?;
    }
    let child = command.spawn().map_err(|error| {
        let program = program.to_string_lossy();
        Failure::caused_by(Exit::Internal, format!("cannot start `{program}`"), &error)
    })?;
    drop((page, pipe));
    let watched = Watched { child, pulse, signals, group };
    let ended =
        watched.until_its_end().map_err(|error| cannot("cannot watch over the runtime", &error))?;
    let orphans = orphans::end();
    if orphans > 0 {
        eprintln!("gleaner-shim: ended {orphans} processes that the runtime had left behind");
    }
    let record = ended.record(started_ns, orphans);
    if let Some(path) = &args.exit_record {
        // A starter that does not read any more has no use for it.
        let written =
            if path.as_os_str() == "-" { record.print().or(Ok(())) } else { record.write(path) };
        if let Err(error) = written {
            // How it ended is more important than that this is not written.
            eprintln!("gleaner-shim: cannot write `{}`: {error}", path.display());
        }
    }
    let written = results.map_or(Ok(()), |results| results.end().finish(&record));
    match written {
        // The runtime's exit code does not include this failure.
        Err(failure) if record.is_in_order() => Err(failure),
        Err(failure) => {
            eprintln!("{failure}");
            Ok(end_alike(&record))
        }
        Ok(()) => Ok(end_alike(&record)),
    }
}

/// Requests SIGTERM for when `starter` dies. The kernel sends it once, so an earlier death is
/// checked here.
fn end_with(starter: u32) -> Result<(), Failure> {
    use rustix::process::{Signal, getppid, set_parent_process_death_signal};
    let cannot = "cannot be told of the starter's death";
    set_parent_process_death_signal(Some(Signal::TERM)).map_err(|error| {
        Failure::caused_by(Exit::Internal, cannot, &std::io::Error::from(error))
    })?;
    let parent = getppid().map(|parent| parent.as_raw_nonzero().get().unsigned_abs());
    if parent == Some(starter) {
        return Ok(());
    }
    let help = "it has ended meanwhile; else give `--starter` the number of the process that starts gleaner-shim";
    Err(Failure::new(
        Exit::Internal,
        format!("process {starter} is not the parent of gleaner-shim"),
    )
    .with_help(help))
}

/// Ends this process as the runtime ended.
fn end_alike(record: &ExitRecord) -> ExitCode {
    // Where the lambda could be made to fit, the user should read how, whichever of us ended it.
    let help = match &record.killed {
        Some(killed) => Some(killed.help()),
        None => record.out_of_memory.then_some("keep less, or raise `memory` in [limits]"),
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

fn hard_deadline() -> Layer {
    Layer::yes(HARD_DEADLINE, "gleaner-shim kills what does not come back")
}

/// The control group that was asked for, and what there is to say of it.
fn own_group(args: &Args) -> (Option<Group>, Layer) {
    let Some(tree) = &args.cgroup else {
        return (None, Layer::no(cgroup::NAME, "none was delegated: --cgroup DIR"));
    };
    let bounds = Bounds { memory: args.cgroup_memory, tasks: args.cgroup_tasks };
    match Group::make(tree, &format!("gleaner-{}", std::process::id()), bounds) {
        Ok(group) => {
            let layer = group.layer();
            (Some(group), layer)
        }
        Err(why) => (None, Layer::no(cgroup::NAME, why)),
    }
}

/// What holds on this machine: each layer is set up in this process, and tried.
fn show_layers(args: &Args) -> Result<ExitCode, Failure> {
    let mut layers = never::forbid();
    let cannot_watch = |error: std::io::Error| {
        Layer::no(HARD_DEADLINE, format!("there is no page to watch: {error}"))
    };
    layers.push(Pulse::make().map_or_else(cannot_watch, |_| hard_deadline()));
    layers.push(own_group(args).1);
    layers.push(files::confine(&Paths::default()));
    layers.push(alone::before_interpreter(true));
    layers.push(memory::limit(64 << 20));
    let cannot =
        |error| Failure::caused_by(Exit::Internal, "cannot try what would hold a lambda", &error);
    layers.extend(alone::stay(true).map_err(cannot)?);
    let layers = tried::tried(layers);
    println!("{}", serde_json::to_string(&layers).expect("layers are plain data"));
    Ok(ExitCode::SUCCESS)
}
