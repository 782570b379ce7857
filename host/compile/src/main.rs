//! `gleaner-compile COMPONENT --cache DIR`: compiles a component and prints the path of its native code.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use gleaner_protocol::{Exit, Failure};

/// Compiles a WebAssembly component to native code for this machine.
#[derive(Parser)]
#[command(version)]
struct Args {
    /// The component.
    component: PathBuf,
    /// Folder of the compiled code; made if it is missing.
    #[arg(long, value_name = "DIR")]
    cache: PathBuf,
}

fn main() -> ExitCode {
    let args = Args::parse();
    match gleaner_compile::compile(&args.component, &args.cache) {
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
