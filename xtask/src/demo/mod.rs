//! `cargo xtask demo`: shows Gleaner's main functions end to end.
//!
//! - `drive`: replays the sample drive with every example, and repeats the decisions.
//! - `vehicle`: runs the examples on a vehicle, in a network of its own, by a cloud; `vehicle_run`
//!   is the part inside of that network, `demo_vehicle` its programs, `demo_cloud` the cloud
//!   outside, `relay` the connection between them, and `arrivals` compares what reached the cloud.

mod arrivals;
mod demo_cloud;
mod demo_vehicle;
mod drive;
mod relay;
mod vehicle;
mod vehicle_run;

use std::ffi::OsString;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::examples::{EXAMPLES, Example};
use crate::setup;
use crate::steps::Steps;

pub(crate) use vehicle_run::{COMMAND as VEHICLE_COMMAND, run as run_vehicle};

/// Shows both parts. The first failure is the exit code, and does not skip the second part. Unless
/// `--no-wait` is given, the page of the cloud is open until Ctrl-C.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let stays_open = match arguments {
        [] => true,
        [one] if one == "--no-wait" => false,
        _ => {
            let message = "`cargo xtask demo` takes `--no-wait` or nothing";
            return Err(Failure::new(Exit::Usage, message));
        }
    };
    let mut steps = Steps::of(setup::STEPS + 2);
    setup::run(
        checkout,
        &mut steps,
        &EXAMPLES.iter().flat_map(Example::lambdas).collect::<Vec<_>>(),
    )?;
    let agree = drive::run(checkout, &mut steps)?;
    println!();
    let ran = vehicle::run(checkout, &mut steps, stays_open)?;
    Ok(if agree == Exit::Ok { ran } else { agree })
}
