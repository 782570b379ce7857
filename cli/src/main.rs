//! The program `gleaner`. See `gleaner --help`.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    match gleaner_cli::run(gleaner_cli::args::Cli::parse()) {
        Ok(exit) => exit.into(),
        Err(failure) => {
            eprintln!("{failure}");
            failure.exit.into()
        }
    }
}
