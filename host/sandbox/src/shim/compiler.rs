//! Runs a compiler in the place of a runtime: a build runs code of the lambda's author, in build
//! scripts and macros. With `--network` that is pip.

use std::ffi::OsStr;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_protocol::process_stats::Heartbeat;

use super::signals::{Signals, time_of_day_ns};
use super::watch::RunningProcess;
use super::{Args, cannot, environment, exit_like, orphans, start};
use crate::{Paths, compiler};

/// Longest time that a build may take.
const LONGEST: Duration = Duration::from_secs(24 * 3600);

/// Runs the program sandboxed: it can read the named paths and the system, and write only the named
/// paths. Waits for its end.
///
/// The shim starts itself for that: the second process is sandboxed and becomes the program, so the
/// author's code can neither read the environment of the first nor end it.
pub(crate) fn run(args: &Args, signals: Signals) -> Result<ExitCode, Failure> {
    orphans::adopt().map_err(cannot("cannot adopt the orphans of a compiler"))?;
    let (heartbeat, page) =
        Heartbeat::create().map_err(cannot("cannot make a page for the heartbeat"))?;
    heartbeat.alive(LONGEST);
    drop(page);
    let shim = std::env::current_exe().map_err(cannot("cannot find gleaner-shim"))?;
    let mut command = Command::new(&shim);
    command.args(["--compiler", "--inside"]);
    for (flag, paths) in [("--read", &args.read), ("--write", &args.write)] {
        command.args(paths.iter().flat_map(|path| [OsStr::new(flag), path.as_os_str()]));
    }
    if args.network {
        // Its starter has chosen the environment.
        command.arg("--network");
    } else {
        command.env_clear().envs(environment::for_compiler());
    }
    command.arg("--").args(&args.program);
    let child = start(&mut command)?;
    let ended = RunningProcess { child, heartbeat, signals, group: None }.wait();
    let ended = ended.map_err(cannot("cannot watch over the compiler"))?;
    // A process that still runs could change the output while it is copied.
    let orphans = orphans::kill_all();
    Ok(exit_like(&ended.record(time_of_day_ns(), orphans)))
}

/// Enters the sandbox and becomes the program. Returns only on errors.
pub(crate) fn enter(args: &Args) -> Failure {
    let (program, arguments) = args.program.split_first().expect("clap asks for a program");
    let mut paths = Paths { read: args.read.clone(), write: args.write.clone() };
    if args.network {
        paths.interpreter(Path::new(program));
    }
    if let Err(layer) = compiler::enter(&paths, args.network) {
        let message = format!(
            "this machine cannot sandbox a compiler: `{}` does not hold ({})",
            layer.name, layer.note
        );
        let help = "build on a kernel that has it (Landlock with signals: Linux 6.12), or, if you \
                    trust the lambda's author, without --sandboxed";
        return Failure::new(Exit::Denied, message).with_help(help);
    }
    let error = Command::new(program).args(arguments).exec();
    cannot(format!("cannot start `{}`", program.to_string_lossy()))(error)
}
