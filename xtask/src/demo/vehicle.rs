//! The second part of the demo: starts the cloud, if there is one, and `vehicle_run` in a private
//! network, so that no DDS participant of another program sees it. A relay connects both.

use std::fs;
use std::io::{self, Read};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitStatus, Stdio};
use std::thread;

use gleaner_base::{Exit, Failure};
use rustix::process::{Pid, Signal, kill_process_group};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use super::demo_cloud::DemoCloud;
use super::{DemoOptions, relay, vehicle_run};
use crate::checkout::Checkout;
use crate::player;
use crate::private_folder::PrivateFolder;
use crate::steps::{self, Steps};

/// Shell script that prepares the network for DDS, then becomes the program in `$0`.
const SET_UP: &str = "ip link set lo up && ip link set lo multicast on && \
                      ip route add 224.0.0.0/4 dev lo && exec \"$0\" \"$@\"";

/// Runs the part; skips it with a line if the player cannot be fetched, or no network be created.
pub(super) fn run(
    checkout: &Checkout,
    steps: &mut Steps,
    options: &DemoOptions,
) -> Result<Exit, Failure> {
    let by = if options.has_cloud { ", by a cloud" } else { "" };
    steps.begin(&format!("the same lambdas on a vehicle, in a network of its own{by}"));
    if !checkout.program("gleaner-player").is_file() {
        match player::run(checkout) {
            Err(failure) if failure.exit == Exit::Unreachable => {
                let why = failure.message;
                return Ok(skipped(&format!(
                    "there is no gleaner-player, and its tools cannot be fetched: {why}"
                )));
            }
            built => built?,
        };
    }
    // Root needs only `-n`; other users become root of a user namespace, where that is permitted.
    let candidates: [&[&str]; 2] = [&["-n"], &["-r", "-n"]];
    let permitted = candidates
        .into_iter()
        .find(|options| steps::succeeds(shell(checkout, options).arg("true")));
    let Some(unshare) = permitted else {
        return Ok(skipped("`unshare -n` or `ip` is missing or not permitted here"));
    };
    let program = std::env::current_exe().map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot find the program of xtask", &error)
    })?;
    let failed =
        |error| Failure::caused_by(Exit::Internal, "cannot start a private network", &error);
    // The folder of the sockets: in a temporary place, as their paths must be short.
    let run = PrivateFolder::create("demo")?;
    fs::create_dir(run.path().join("relay")).map_err(failed)?;
    let mut vehicle = shell(checkout, unshare);
    vehicle.arg(program).arg(vehicle_run::COMMAND).arg(run.path());
    let cloud = options.has_cloud.then(|| DemoCloud::start(checkout)).transpose()?;
    if let Some(cloud) = &cloud {
        relay::out_of(&run.path().join("relay"), &cloud.ports).map_err(failed)?;
        vehicle.arg(vehicle_run::BY_CLOUD);
        if options.stays_open {
            vehicle.arg(&cloud.url);
        }
    }
    let status = run_to_end(&mut vehicle).map_err(failed)?;
    cloud.map_or(Ok(()), DemoCloud::stop)?;
    // It has printed its error.
    Ok(status.code().and_then(Exit::from_code).unwrap_or(Exit::Internal))
}

/// Runs the part in the private network to its end. Ctrl-C, and other wishes that the demo ends,
/// become a SIGTERM to all of its processes, which end in order.
fn run_to_end(vehicle: &mut Command) -> io::Result<ExitStatus> {
    let (mut signals, notifier) = UnixStream::pair()?;
    for signal in [SIGHUP, SIGINT, SIGTERM] {
        signal_hook::low_level::pipe::register(signal, notifier.try_clone()?)?;
    }
    // In a process group of its own, which a terminal does not signal.
    let mut program = vehicle.process_group(0).stdin(Stdio::null()).spawn()?;
    let group = i32::try_from(program.id()).ok().and_then(Pid::from_raw);
    thread::spawn(move || {
        while let (Ok(1..), Some(group)) = (signals.read(&mut [0]), group) {
            let _ = kill_process_group(group, Signal::TERM);
        }
    });
    program.wait()
}

fn shell(checkout: &Checkout, options: &[&str]) -> Command {
    let mut command = checkout.command("unshare");
    command.args(options).args(["--", "sh", "-c", SET_UP]);
    command
}

fn skipped(why: &str) -> Exit {
    println!("skipped: {why}");
    Exit::Ok
}
