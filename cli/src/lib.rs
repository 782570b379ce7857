//! The command `gleaner`.
//!
//! `new` creates a lambda's folder, `build` its build folder. `runtime` starts `gleaner-runtime`
//! for `check`, `replay` and `verify`, `run` runs lambdas live by `gleaner-supervisor`, `engines`
//! builds engines of models ahead, `signing` makes keys and signs builds, `vehicle` deploys builds
//! and shows what runs, `cloud` does so for the vehicles of a cloud, whose address and token are in
//! `account`, and `delegate` passes commands on to another program. `render` formats results as
//! text, `report` writes the report page, `diff` compares two runs, and `dev` repeats all of this
//! whenever a source is saved. `generated` prints shell completions and man pages.
//!
//! No lambda runs in this process, and it links neither a WebAssembly engine nor Python: it starts
//! the other programs and exchanges `gleaner-protocol` messages with them. `gleaner-report` reads
//! results.

mod account;
pub mod args;
mod build;
mod check;
mod cloud;
mod delegate;
pub mod dev;
mod diff;
mod doctor;
mod engines;
mod generated;
mod new;
mod output;
mod pipe_reader;
mod render;
mod replay;
mod report;
mod run;
mod runtime;
mod separate;
mod signing;
mod vehicle;

use std::fs;
use std::io;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure};

use args::{Cli, CliCommand};
use cloud::Change;

/// Runs the command.
///
/// # Errors
///
/// A [`Failure`] with the message for the user and the exit code.
pub fn run(cli: Cli) -> Result<Exit, Failure> {
    match cli.command {
        CliCommand::Inspect(args) => delegate::inspect(&args),
        CliCommand::New(args) => new::run(&args),
        CliCommand::Build(args) => build::run(&args),
        CliCommand::Check(args) => check::run(&args),
        CliCommand::Replay(args) => replay::run(&args),
        CliCommand::Report(args) => report::run(&args),
        CliCommand::Diff(args) => diff::run(&args),
        CliCommand::Dev(args) => dev::run(args),
        CliCommand::Verify(args) => replay::verify(&args),
        CliCommand::Run(args) => run::run(&args),
        CliCommand::Topics(args) => delegate::topics(&args),
        CliCommand::Play { arguments } => delegate::replace("gleaner-player", &arguments),
        CliCommand::Keys(command) => signing::keys(&command),
        CliCommand::Publish(args) => signing::publish(&args),
        CliCommand::Trust(command) => vehicle::trust(&command),
        CliCommand::Deploy(args) if args.fleet => cloud::deploy(&args),
        CliCommand::Rollback(args) if args.fleet => cloud::change(&args, Change::Rollback),
        CliCommand::Start(args) if args.fleet => cloud::change(&args, Change::Start),
        CliCommand::Stop(args) if args.fleet => cloud::change(&args, Change::Stop),
        CliCommand::Remove(args) if args.fleet => cloud::change(&args, Change::Remove),
        CliCommand::Deploy(args) => vehicle::deploy(&args),
        CliCommand::Rollback(args) => vehicle::change(&args, "rollback"),
        CliCommand::Start(args) => vehicle::change(&args, "start"),
        CliCommand::Stop(args) => vehicle::change(&args, "stop"),
        CliCommand::Remove(args) => vehicle::remove(&args),
        CliCommand::Status(args) => vehicle::status(&args),
        CliCommand::Top(args) => vehicle::top(&args),
        CliCommand::Logs(args) => vehicle::logs(&args),
        CliCommand::Events(args) => vehicle::events(&args),
        CliCommand::Cloud(command) => cloud::run(&command),
        CliCommand::Doctor(args) => doctor::run(&args),
        CliCommand::Completions { shell } => generated::completions(shell),
        CliCommand::Man { folder } => generated::man(&folder),
    }
}

/// Returns the time since 1970; a clock before that counts as 1970.
fn since_1970() -> Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

fn remove_folder(folder: &Path) -> io::Result<()> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}
