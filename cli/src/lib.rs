//! The command `gleaner`: `new` makes a lambda's folder, `build` its build folder, `runtime` starts
//! `gleaner-runtime` for `check`, `replay` and `verify`, `run` keeps it and the recorder going
//! live, `show` is what people see of results, `report` writes the page about them, `diff` shows
//! what differs between two runs, `dev` does all of it again whenever a source is saved, and
//! `generated` is what is made from the command line's definition.
//!
//! It is thin. No lambda runs in this process, and it links neither a WebAssembly engine nor
//! Python: it starts its sibling programs and speaks to them through `gleaner-protocol`. What is
//! known of results is in `gleaner-report`.

pub mod args;
mod build;
mod check;
pub mod dev;
mod diff;
mod doctor;
mod generated;
mod listen;
mod new;
mod replay;
mod report;
mod run;
mod runtime;
mod say;
mod show;
mod sibling;

use gleaner_base::{Exit, Failure};

use args::{Cli, Command};

/// Does what was typed.
///
/// # Errors
///
/// What the user is to see, with the exit code.
pub fn run(cli: Cli) -> Result<Exit, Failure> {
    match cli.command {
        Command::Inspect(args) => sibling::inspect(&args),
        Command::New(args) => new::run(&args),
        Command::Build(args) => build::run(&args.lambda, args.sandboxed),
        Command::Check(args) => check::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Diff(args) => diff::run(&args),
        Command::Dev(args) => dev::run(args),
        Command::Verify(args) => replay::verify(&args),
        Command::Run(args) => run::run(&args),
        Command::Topics(args) => sibling::topics(&args),
        Command::Play { arguments } => sibling::play(&arguments),
        Command::Doctor(args) => doctor::run(&args),
        Command::Completions { shell } => generated::completions(shell),
        Command::Man { folder } => generated::man(&folder),
    }
}
