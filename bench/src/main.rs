//! Measures Gleaner with the programs that users run. `cargo xtask bench` builds these first.
//!
//! Variants alternate, so that drift of the machine affects all of them alike. Each benchmark
//! writes its results as JSON, as Markdown, and as a page with plots.

mod all;
mod answers;
mod drives;
mod inference;
mod isolation;
mod kernels;
mod live;
mod measure;
mod record;
mod replay;
mod rtt;

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use clap::{Parser, Subcommand};
use gleaner_base::Failure;
use gleaner_bench_results::{BenchResults, Comparison};
use gleaner_tests::root;

/// Measures Gleaner against its performance goals; ends with exit code 1 if one is not met.
#[derive(Parser)]
#[command(name = "gleaner-bench", bin_name = "cargo xtask bench")]
#[command(version = gleaner_base::version())]
struct Args {
    /// Fewer and shorter rounds: shows that a benchmark works; the values mean nothing.
    #[arg(long, global = true)]
    quick: bool,
    /// Folder for results.json, results.md and report.html [default: target/bench/NAME].
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
    Inference,
    /// Runs as gleaner-runtime, with a guest that the product does not have.
    #[command(hide = true)]
    Guest {
        /// The guest.
        guest: isolation::BenchGuest,
        /// Arguments of gleaner-runtime.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<OsString>,
    },
    /// Writes a model of the shape of YOLO11, with random weights, and measures nothing.
    Model {
        /// Scale of the model.
        scale: inference::GraphScale,
        /// The file to write.
        file: PathBuf,
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
    let args = Args::parse();
    let done = match &args.command {
        BenchCommand::Model { scale, file } => return write_model(*scale, file),
        BenchCommand::Guest { guest, arguments } => {
            return isolation::run_as_runtime(*guest, arguments.clone());
        }
        BenchCommand::Compare { a, b } => compare(a, b),
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
                return Ok(ExitCode::SUCCESS);
            }
            None => {}
        }
    } else if command.is_on_one_core()
        && let Err(error) = measure::bind_to_one_core()
    {
        eprintln!("cannot bind to one core, measuring on all cores: {error}");
    }
    let quick = args.quick;
    let mut results = BenchResults::new(name, quick);
    add_versions(&mut results);
    match command {
        BenchCommand::Rtt { options } => rtt::measure(quick, options, &mut results),
        BenchCommand::Scale { options } => live::loads(quick, options, &mut results),
        BenchCommand::Isolation { options } => isolation::measure(quick, options, &mut results),
        BenchCommand::ColdStart => drop(isolation::starts(quick, &mut results)),
        BenchCommand::Replay => results.figures = replay::figures(quick),
        BenchCommand::Record => results.figures = record::figures(quick),
        BenchCommand::Drives => drives::measure(quick, &mut results),
        BenchCommand::Kernels => results.figures = kernels::figures(quick),
        BenchCommand::Inference => inference::measure(quick, &mut results),
        BenchCommand::All { .. }
        | BenchCommand::Guest { .. }
        | BenchCommand::Model { .. }
        | BenchCommand::Compare { .. } => {}
    }
    results.machine.add_load("load after");
    let folder = args.out.clone().unwrap_or_else(|| root().join("target/bench").join(name));
    print!("{}", results.to_markdown());
    results.store(&folder)?;
    println!("\nresults and page: {}", folder.display());
    Ok(ExitCode::from(u8::from(!results.is_good())))
}

impl BenchCommand {
    /// The name of its results.
    fn name(&self) -> &'static str {
        match self {
            Self::All { .. } => "all",
            Self::Rtt { .. } => "rtt",
            Self::Scale { .. } => "scale",
            Self::Isolation { .. } => "isolation",
            Self::ColdStart => "cold-start",
            Self::Replay => "replay",
            Self::Record => "record",
            Self::Drives => "drives",
            Self::Kernels => "kernels",
            Self::Inference => "inference",
            Self::Guest { .. } => "guest",
            Self::Model { .. } => "model",
            Self::Compare { .. } => "compare",
        }
    }

    /// Returns whether it needs a network of its own.
    fn is_live(&self) -> bool {
        match self {
            Self::Isolation { options } => options.has_attacks(),
            Self::Rtt { .. } | Self::Scale { .. } => true,
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
    machine.add_version("python", Command::new(measure::python()).arg("--version"));
}

fn compare(a: &Path, b: &Path) -> Result<ExitCode, Failure> {
    let comparison = Comparison::between(&BenchResults::read(a)?, &BenchResults::read(b)?);
    print!("{}", comparison.to_markdown());
    Ok(ExitCode::SUCCESS)
}

fn write_model(scale: inference::GraphScale, file: &Path) -> ExitCode {
    let (model, parameters) = inference::yolo_shaped(scale);
    match std::fs::write(file, &model) {
        Ok(()) => {
            println!("{}: {parameters} parameters, {} bytes", file.display(), model.len());
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: cannot write `{}`\n  cause: {error}", file.display());
            ExitCode::FAILURE
        }
    }
}
