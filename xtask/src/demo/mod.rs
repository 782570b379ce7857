//! `cargo xtask demo`: shows Gleaner's main functions end to end.
//!
//! - `drive`: replays the sample drive with every example, and repeats the decisions.
//! - `vehicle`: runs the examples on a vehicle, in a network of its own; `vehicle_run` is the part
//!   inside of that network, `demo_vehicle` its programs.

mod demo_vehicle;
mod drive;
mod vehicle;
mod vehicle_run;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::examples::{EXAMPLES, Example};
use crate::setup;
use crate::steps::Steps;

pub(crate) use vehicle_run::{COMMAND as VEHICLE_COMMAND, run as run_vehicle};

/// Shows both parts. The first failure is the exit code, and does not skip the second part.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut steps = Steps::of(setup::STEPS + 2);
    setup::run(
        checkout,
        &mut steps,
        &EXAMPLES.iter().flat_map(Example::lambdas).collect::<Vec<_>>(),
    )?;
    let agree = drive::run(checkout, &mut steps)?;
    println!();
    let ran = vehicle::run(checkout, &mut steps)?;
    Ok(if agree == Exit::Ok { ran } else { agree })
}
