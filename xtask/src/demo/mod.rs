//! `cargo xtask demo`: shows Gleaner's main functions end to end.
//!
//! - `drive`: replays the sample drive with every example, and repeats the decisions.
//! - `vehicle`: runs the examples on a vehicle, in a network of its own; `vehicle_run` is the part
//!   inside of that network, `demo_vehicle` its programs, `demo_cloud` the cloud outside, `relay`
//!   the connection between them, and `arrivals` compares what reached the cloud.

mod arrivals;
mod demo_cloud;
mod demo_vehicle;
mod drive;
mod relay;
mod vehicle;
mod vehicle_run;

use std::ffi::OsString;

use gleaner_base::{Exit, Failure};

use crate::architecture::Architecture;
use crate::checkout::Checkout;
use crate::examples::{DRIVE, EXAMPLES, Example};
use crate::onnxruntime;
use crate::setup;
use crate::steps::Steps;

pub(crate) use vehicle_run::{COMMAND as VEHICLE_COMMAND, run as run_vehicle};

struct DemoOptions {
    /// The page of the cloud is open until Ctrl-C.
    stays_open: bool,
    /// The vehicle has a cloud.
    has_cloud: bool,
}

impl DemoOptions {
    fn parse(arguments: &[OsString]) -> Option<Self> {
        let mut options = Self { stays_open: true, has_cloud: true };
        for argument in arguments {
            match argument.to_str()? {
                "--no-wait" => options.stays_open = false,
                "--no-fleet" => options.has_cloud = false,
                _ => return None,
            }
        }
        Some(options)
    }
}

/// Shows first what needs the fewest programs: the drive, then a vehicle, with a cloud unless
/// `--no-fleet` is given. The first failure is the exit code, and does not skip what follows.
/// Unless `--no-wait` is given, the page of the cloud is open until Ctrl-C.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let options = DemoOptions::parse(arguments).ok_or_else(|| {
        let message = "`cargo xtask demo` takes `--no-fleet`, `--no-wait`, both or nothing";
        Failure::new(Exit::Usage, message)
    })?;
    let mut steps = Steps::of(setup::STEPS + 4 + usize::from(options.has_cloud));
    let lambdas: Vec<_> = EXAMPLES.iter().flat_map(Example::lambdas).collect();
    setup::run_with(checkout, &mut steps, &lambdas, setup::replay_programs)?;
    let (with_models, others): (Vec<_>, Vec<_>) = EXAMPLES.iter().partition(|it| it.has_models);
    steps.begin(&format!("replay of {DRIVE}"));
    let others_agree = drive::run(checkout, &others)?;
    steps.begin("programs of a vehicle");
    setup::vehicle_programs(checkout)?;
    steps.begin(&format!("replay of {DRIVE} with a model"));
    onnxruntime::fetch(checkout, Architecture::of_this_machine());
    let agree = drive::run(checkout, &with_models)? && others_agree;
    drive::print_files(checkout);
    if options.has_cloud {
        steps.begin("the cloud");
        setup::programs(checkout)?;
    }
    let ran = vehicle::run(checkout, &mut steps, &options)?;
    steps.end();
    Ok(if agree { ran } else { Exit::Differs })
}
