//! Measures Gleaner with the programs that users run. `cargo xtask bench` builds these first.
//!
//! Variants alternate, so that drift of the machine affects all of them alike. Each benchmark
//! writes its results as JSON; `bench/analysis` makes tables, figures and a page of them.

mod all;
mod answers;
mod drives;
mod inference;
mod isolation;
mod kernels;
mod live;
mod measure;
mod native_rules;
mod record;
mod replay;
mod rtt;

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use clap::{Parser, Subcommand};
use gleaner_base::{Exit, Failure};
use gleaner_bench::BenchResults;
use gleaner_tests::root;
use isolation::BenchGuest;

/// Exit code of a benchmark that cannot run on this machine.
const SKIPPED: u8 = 3;

/// Measures Gleaner against its performance goals; ends with exit code 1 if one is not met.
#[derive(Parser)]
#[command(version = gleaner_base::version())]
struct Args {
    /// A smoke test with fewer and shorter rounds: its values are not meaningful.
    #[arg(long, global = true)]
    quick: bool,
    /// Folder for results.json, tables, figures and report.html [default: target/bench/NAME].
    #[arg(long, global = true, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Subcommand, Clone)]
enum BenchCommand {
    /// All benchmarks of a vehicle, one after the other; the results become one file.
    All {
        /// A benchmark to leave out; may be repeated.
        #[arg(long, value_name = "NAME")]
        skip: Vec<String>,
    },
    /// The table and the figures of the paper: three workloads, each as native ROS 2, in Python and
    /// in wasm, in some 25 minutes; needs gleaner-player.
    Paper {
        #[command(flatten)]
        options: rtt::RttOptions,
    },
    /// Round trips from a sample to its answer, against a bare reader and programs without
    /// Gleaner; needs gleaner-player.
    Rtt {
        #[command(flatten)]
        options: rtt::RttOptions,
    },
    /// Samples that one and several lambdas receive, and their costs; needs gleaner-player.
    Scale {
        #[command(flatten)]
        options: live::ScaleOptions,
    },
    /// Costs of isolation: the same lambda as native code, in wasm and in Python; memory, starts
    /// and faults; and the effect of a misbehaving lambda on others. Needs gleaner-player.
    Isolation {
        #[command(flatten)]
        options: isolation::IsolationOptions,
    },
    /// The start of a lambda.
    ColdStart,
    /// Replays: speed, memory, and the cost of a journal and of clips.
    Replay,
    /// The recorder at 20 MB/s.
    Record,
    /// Drives of 2 GB in each storage format; takes 5 GB of disk.
    Drives,
    /// Arithmetic in lambdas against the same code natively.
    Kernels,
    /// Detectors: a frame's way through gleaner-inference, by rten and, if ORT_DYLIB_PATH is set,
    /// by ONNX Runtime, against a plain Python program; several lambdas of one model.
    Inference {
        #[command(flatten)]
        options: inference::InferenceOptions,
    },
    /// Runs as gleaner-runtime, with a guest that the product does not have.
    #[command(hide = true)]
    Guest {
        /// The guest.
        guest: BenchGuest,
        /// Arguments of gleaner-runtime.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<OsString>,
    },
    /// Runs as a native node without Gleaner.
    #[command(hide = true)]
    Node {
        #[command(flatten)]
        options: rtt::NodeOptions,
    },
    /// Makes the tables, the figures and the page of stored results.
    Render {
        /// The folder of the results.
        folder: PathBuf,
    },
    /// Compares two results: effect size and interval of each measurement.
    Compare {
        /// The folder or file of the results to compare with.
        a: PathBuf,
        /// Those that are compared.
        b: PathBuf,
    },
}

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    let mut arguments = std::env::args_os();
    let program = arguments.next().map(PathBuf::from).unwrap_or_default();
    // A copy in the place of the runtime, for a side without checks.
    if program.file_name().is_some_and(|name| name == "gleaner-runtime") {
        return isolation::run_as_runtime(BenchGuest::Unchecked, arguments.collect());
    }
    let args = Args::parse();
    let done = match &args.command {
        BenchCommand::Guest { guest, arguments } => {
            return isolation::run_as_runtime(*guest, arguments.clone());
        }
        BenchCommand::Node { options } => return rtt::run_node(options),
        BenchCommand::Render { folder } => {
            gleaner_bench::render(folder).map(|()| ExitCode::SUCCESS)
        }
        BenchCommand::Compare { a, b } => gleaner_bench::compare(a, b).map(|()| ExitCode::SUCCESS),
        BenchCommand::All { skip } => all::run(args.quick, skip, args.out.as_deref()),
        command => measure(command, &args),
    };
    done.unwrap_or_else(|failure| {
        eprintln!("{failure}");
        failure.exit.into()
    })
}

/// Runs a benchmark, and stores its results.
fn measure(command: &BenchCommand, args: &Args) -> Result<ExitCode, Failure> {
    let name = command.name();
    if command.is_live() {
        match live::in_private_network() {
            Some(Ok(is_good)) => return Ok(ExitCode::from(u8::from(!is_good))),
            Some(Err(why)) => {
                println!("skipped: {why}");
                return Ok(ExitCode::from(SKIPPED));
            }
            None => live::end_with_the_starter(),
        }
    } else if command.is_on_one_core()
        && let Err(error) = measure::bind_to_one_core()
    {
        eprintln!("cannot bind to one core, measuring on all cores: {error}");
    }
    let folder = args.out.clone().unwrap_or_else(|| root().join("target/bench").join(name));
    let quick = args.quick;
    let mut results = BenchResults::new(name, quick);
    add_versions(&mut results);
    if command.is_resumed() {
        results = resumed(results, &folder)?;
    } else {
        BenchResults::keep_previous(&folder)?;
        // What is aborted in its first part can be resumed, too.
        results.store(&folder)?;
    }
    let measured = measure::caught(|| run(command, quick, &mut results, &folder));
    results.is_complete = measured.is_ok();
    if let Err(why) = &measured {
        eprintln!("error: the benchmark `{name}` failed\n  cause: {why}");
    }
    measured.unwrap_or(Ok(()))?;
    results.machine.add_load("load after");
    results.store(&folder)?;
    gleaner_bench::render(&folder)?;
    Ok(ExitCode::from(u8::from(!(results.is_complete && results.is_good()))))
}

/// Returns the results in `folder`, which an earlier part of the same run has stored.
fn resumed(now: BenchResults, folder: &Path) -> Result<BenchResults, Failure> {
    let mut stored = BenchResults::read(folder)?;
    let mut changed = now.changed_facts(&stored);
    if (&stored.bench, stored.is_quick) != (&now.bench, now.is_quick) {
        changed.push(format!("benchmark: {}, before {}", now.bench, stored.bench));
    }
    if !changed.is_empty() {
        let message = format!("cannot resume the results in `{}`", folder.display());
        let mut failure = Failure::new(Exit::Usage, message);
        failure.causes = changed;
        return Err(failure.with_help("measure again without --resume, into another --out DIR"));
    }
    stored.is_complete = false;
    Ok(stored)
}

fn run(
    command: &BenchCommand,
    quick: bool,
    results: &mut BenchResults,
    folder: &Path,
) -> Result<(), Failure> {
    let mut save = |results: &BenchResults| results.store(folder);
    match command {
        BenchCommand::Rtt { options } => return rtt::measure(quick, options, results, &mut save),
        BenchCommand::Paper { options } => return rtt::paper(quick, options, results, &mut save),
        BenchCommand::Scale { options } => live::loads(quick, options, results),
        BenchCommand::Isolation { options } => isolation::measure(quick, options, results),
        BenchCommand::ColdStart => isolation::starts(quick, results),
        BenchCommand::Replay => results.figures = replay::figures(quick),
        BenchCommand::Record => results.figures = record::figures(quick),
        BenchCommand::Drives => drives::measure(quick, results),
        BenchCommand::Kernels => results.figures = kernels::figures(quick),
        BenchCommand::Inference { options } => inference::measure(quick, options, results),
        BenchCommand::All { .. }
        | BenchCommand::Guest { .. }
        | BenchCommand::Node { .. }
        | BenchCommand::Render { .. }
        | BenchCommand::Compare { .. } => {}
    }
    Ok(())
}

impl BenchCommand {
    /// The name of its results.
    fn name(&self) -> &'static str {
        match self {
            Self::All { .. } => "all",
            Self::Rtt { .. } => "rtt",
            Self::Paper { .. } => "paper",
            Self::Scale { .. } => "scale",
            Self::Isolation { .. } => "isolation",
            Self::ColdStart => "cold-start",
            Self::Replay => "replay",
            Self::Record => "record",
            Self::Drives => "drives",
            Self::Kernels => "kernels",
            Self::Inference { .. } => "inference",
            Self::Guest { .. } => "guest",
            Self::Node { .. } => "node",
            Self::Render { .. } => "render",
            Self::Compare { .. } => "compare",
        }
    }

    /// Returns whether it needs a network of its own.
    fn is_live(&self) -> bool {
        match self {
            Self::Isolation { options } => options.has_attacks(),
            Self::Rtt { .. } | Self::Paper { .. } | Self::Scale { .. } => true,
            _ => false,
        }
    }

    /// Returns whether it goes on with the results of an earlier run.
    fn is_resumed(&self) -> bool {
        match self {
            Self::Rtt { options } => options.resume,
            Self::Paper { options } => options.resume,
            _ => false,
        }
    }

    /// Returns whether it has only one process at a time, which is not to move between cores.
    fn is_on_one_core(&self) -> bool {
        matches!(self, Self::Replay | Self::Record | Self::Drives | Self::Kernels)
    }
}

/// Adds the versions of what is measured.
fn add_versions(results: &mut BenchResults) {
    let machine = &mut results.machine;
    machine.add("net.core.rmem_max", live::limit_before());
    machine.add_version("measured", Command::new("date").args(["-u", "+%Y-%m-%d %H:%M UTC"]));
    // A tarball states it in a file, and may be unpacked in a checkout of something else.
    let mut revision = Command::new("cat");
    revision.arg(root().join("REVISION"));
    if !root().join("REVISION").is_file() {
        revision = Command::new("git");
        revision.args(["describe", "--always", "--dirty", "--abbrev=12"]).current_dir(root());
    }
    machine.add_version("revision", &mut revision);
    machine.add_version("rustc", Command::new("rustc").arg("--version"));
    machine.add_version("python", Command::new(gleaner_bench::python()).arg("--version"));
}
