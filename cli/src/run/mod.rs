//! `gleaner run DIR...`: runs lambdas until Ctrl-C or the end of a drive, and prints their reports.
//!
//! `gleaner-supervisor` starts and supervises the processes. `lambdas` loads the lambdas of the
//! command line with their settings, and `screen` prints to the terminal.

mod lambdas;
mod screen;

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_supervisor::{ClipSigning, RunSpec};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use self::screen::Screen;
use crate::args::RunArgs;
use crate::signing;

/// Runs until a signal, until the time is over, or until the end of the drive.
pub(crate) fn run(args: &RunArgs) -> Result<Exit, Failure> {
    let lambdas = lambdas::load(args)?;
    let signing = signing::of_clips(&args.sign)?;
    let stop = stop_flag()?;
    let mut screen = Screen::new(args.stats, args.json);
    gleaner_supervisor::run(lambdas, &spec(args, signing), &mut screen, &stop)
}

fn spec(args: &RunArgs, signing: Option<ClipSigning>) -> RunSpec {
    let real_time = args.real_time.then(|| "--real-time".into());
    RunSpec {
        clips: lambdas::out(args),
        vehicle: args.vehicle.clone(),
        drives: args.drive.clone(),
        merge: args.merge,
        rate: args.rate,
        network: args.network.to_args().chain(real_time).collect(),
        largest: 0,
        duration: args.last.map(|seconds| Duration::from_secs(seconds.into())),
        all: args.all,
        records: !args.no_record,
        rtt: args.rtt.clone(),
        decisions: args.decisions.clone(),
        commands: args.commands.clone(),
        disk_floor: args.disk_floor,
        clips_max: args.clips_max,
        bytes_max: args.bytes_max,
        signing,
        cgroup: args.cgroup.clone(),
        spool: None,
    }
}

/// Returns a flag that is set by Ctrl-C, SIGTERM, and the end of the terminal.
pub(crate) fn stop_flag() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&stop))
            .map_err(|error| Failure::caused_by(Exit::Internal, "cannot handle signals", &error))?;
    }
    Ok(stop)
}
