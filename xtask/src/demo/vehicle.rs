//! The second part of the demo: starts `vehicle_run` in a private network, so that no DDS
//! participant of another program sees it.

use std::process::Command;

use gleaner_base::{Exit, Failure};

use super::vehicle_run;
use crate::checkout::Checkout;
use crate::player;
use crate::steps::{self, Steps};

/// Shell script that prepares the network for DDS, then becomes the program in `$0`.
const SET_UP: &str = "ip link set lo up && ip link set lo multicast on && \
                      ip route add 224.0.0.0/4 dev lo && exec \"$0\" \"$@\"";

/// Runs the part; skips it with a line if the player cannot be fetched, or no network be created.
pub(super) fn run(checkout: &Checkout, steps: &mut Steps) -> Result<Exit, Failure> {
    steps.begin("the same lambdas on a vehicle, in a network of its own");
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
    let Some(options) = permitted else {
        return Ok(skipped("`unshare -n` or `ip` is missing or not permitted here"));
    };
    let program = std::env::current_exe().map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot find the program of xtask", &error)
    })?;
    let status = shell(checkout, options).arg(program).arg(vehicle_run::COMMAND).status();
    let status = status.map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot start a private network", &error)
    })?;
    // It has printed its error.
    Ok(status.code().and_then(Exit::from_code).unwrap_or(Exit::Internal))
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
