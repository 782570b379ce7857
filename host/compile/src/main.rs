//! `gleaner-compile COMPONENT --cache DIR`: compiles a component and prints the path of its native
//! code.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_compile::{COMPILE_CPU_SECONDS, COMPILE_MEMORY_BYTES, CompileError, Nans};
use gleaner_sandbox::{Paths, files, sandbox_filter};
use rustix::process::{Resource, Rlimit, setrlimit};

/// Compiles a WebAssembly component to native code for this machine.
#[derive(Parser)]
#[command(version = gleaner_base::version())]
struct Args {
    /// Measure the speed of this machine instead, and print fuel units per second
    #[arg(long, exclusive = true, hide = true)]
    speed: bool,
    /// The component
    #[arg(required_unless_present = "speed")]
    component: Option<PathBuf>,
    /// Folder of the compiled code; created if missing
    #[arg(long, value_name = "DIR", required_unless_present = "speed")]
    cache: Option<PathBuf>,
    /// Give NaNs the same bits on every CPU
    #[arg(long)]
    deterministic: bool,
    /// Maximum CPU time in seconds, at most the default
    #[arg(
        long,
        value_name = "N",
        default_value_t = COMPILE_CPU_SECONDS,
        value_parser = clap::value_parser!(u64).range(1..=COMPILE_CPU_SECONDS)
    )]
    cpu_seconds: u64,
}

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    let args = Args::parse();
    let done = match (&args.component, &args.cache) {
        (Some(component), Some(cache)) => {
            compile(component, cache, &args).map(|entry| entry.display().to_string())
        }
        _ => gleaner_compile::fuel_per_second().map(|speed| format!("{speed:.0}")),
    };
    match done {
        Ok(line) => {
            println!("{line}");
            Exit::Ok.into()
        }
        Err(error) => {
            let failure = Failure::from(error);
            eprintln!("{failure}");
            failure.exit.into()
        }
    }
}

fn compile(component: &Path, cache: &Path, args: &Args) -> Result<PathBuf, CompileError> {
    limit_resources(args.cpu_seconds);
    sandbox_for(component, cache)?;
    let nans = if args.deterministic { Nans::Canonical } else { Nans::Native };
    gleaner_compile::compile(component, cache, nans)
}

/// Sandboxes this process: it can read only the component and system libraries, and write only the
/// cache, even if a component exploits the compiler. If the kernel does not support that, only the
/// resource limits apply; the parent process reports it.
fn sandbox_for(component: &Path, cache: &Path) -> Result<(), CompileError> {
    gleaner_artifacts::make_store(cache)?;
    let paths = Paths { read: vec![component.to_owned()], write: vec![cache.to_owned()] };
    files::confine(&paths);
    let _ = sandbox_filter::apply(false);
    Ok(())
}

/// Limits memory and CPU time. Beyond them an allocation fails or the kernel kills this process,
/// which the parent process reports.
fn limit_resources(cpu_seconds: u64) {
    let limit = |value, hard| Rlimit { current: Some(value), maximum: Some(hard) };
    // Fails only if tighter limits are set already.
    let _ = setrlimit(Resource::As, limit(COMPILE_MEMORY_BYTES, COMPILE_MEMORY_BYTES));
    // The soft limit sends SIGXCPU, by which the parent process recognises the limit; the hard
    // limit cannot be ignored.
    let _ = setrlimit(Resource::Cpu, limit(cpu_seconds, cpu_seconds + 1));
}
