//! The command `gleaner`: `build` makes a lambda's build folder, `replay` starts the runtime on it and shows what came
//! out, `results` reads back what a replay left.
//!
//! It is thin. No lambda runs in this process, and it links neither a WebAssembly engine nor Python: it starts its
//! sibling programs and speaks to them through `gleaner-protocol`.

pub mod args;
mod build;
mod listen;
mod replay;
pub mod results;
mod say;
mod show;

use gleaner_protocol::{Exit, Failure};

use args::{Cli, Command};

/// Does what was typed.
///
/// # Errors
///
/// What the user is to see, with the exit code.
pub fn run(cli: Cli) -> Result<Exit, Failure> {
    match cli.command {
        Command::Build(args) => build::run(&args.lambda),
        Command::Replay(args) => replay::run(&args),
    }
}
