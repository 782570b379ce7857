//! `gleaner-compile COMPONENT --cache DIR`: compiles a component and prints the path of its native
//! code.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_compile::{COMPILE_CPU_SECONDS, COMPILE_MEMORY_BYTES, CompileError, Nans};
use gleaner_jail::{Paths, alone, files};
use rustix::process::{Resource, Rlimit, setrlimit};

/// Compiles a WebAssembly component to native code for this machine.
#[derive(Parser)]
#[command(version)]
struct Args {
    /// The component.
    component: PathBuf,
    /// Folder of the compiled code; made if it is missing.
    #[arg(long, value_name = "DIR")]
    cache: PathBuf,
    /// Give every NaN the same bits on every CPU.
    #[arg(long)]
    deterministic: bool,
    /// End after so many seconds of CPU time: not more than this is allowed.
    #[arg(long, value_name = "N", default_value_t = COMPILE_CPU_SECONDS, value_parser = clap::value_parser!(u64).range(1..=COMPILE_CPU_SECONDS))]
    cpu_seconds: u64,
}

fn main() -> ExitCode {
    let args = Args::parse();
    bound_this_process(args.cpu_seconds);
    let nans = if args.deterministic { Nans::Canonical } else { Nans::AsMade };
    match confine_to(&args)
        .and_then(|()| gleaner_compile::compile(&args.component, &args.cache, nans))
    {
        Ok(entry) => {
            println!("{}", entry.display());
            Exit::Ok.into()
        }
        Err(error) => {
            let failure = Failure::from(error);
            eprintln!("{failure}");
            failure.exit.into()
        }
    }
}

/// Whatever a component makes of the compiler: it can read that component and the system's
/// libraries, and write into the cache. Where the kernel cannot do that, the bounds above are all
/// there is; what is below this process is said by who runs it.
fn confine_to(args: &Args) -> Result<(), CompileError> {
    gleaner_compile::make_cache(&args.cache)?;
    let paths = Paths { read: vec![args.component.clone()], write: vec![args.cache.clone()] };
    files::confine(&paths);
    let _ = alone::stay(false);
    Ok(())
}

/// Past these limits an allocation fails, or the kernel ends this process; whoever started it says
/// so.
fn bound_this_process(cpu_seconds: u64) {
    let limit = |value, hard| Rlimit { current: Some(value), maximum: Some(hard) };
    // They only tighten, so they fail only where something tighter holds already.
    let _ = setrlimit(Resource::As, limit(COMPILE_MEMORY_BYTES, COMPILE_MEMORY_BYTES));
    // The first comes with a signal by which whoever started this knows the limit; the second
    // cannot be ignored.
    let _ = setrlimit(Resource::Cpu, limit(cpu_seconds, cpu_seconds + 1));
}
