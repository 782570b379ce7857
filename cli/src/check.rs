//! `gleaner check DIR`: loads a built lambda as on a vehicle and runs its `init`, without samples.

use std::ffi::OsString;

use gleaner_base::{Exit, Failure};

use crate::args::CheckArgs;
use crate::engines;
use crate::replay::print_result;
use crate::runtime;

pub(crate) fn run(args: &CheckArgs) -> Result<Exit, Failure> {
    if args.build_engines {
        return engines::build(&args.target.lambda, args.json);
    }
    let mut line: Vec<OsString> = vec!["check".into()];
    line.extend(args.target.settings());
    line.extend(["--".into(), args.target.lambda.clone().into()]);
    print_result(
        runtime::run(&args.target.lambda, args.target.vehicle.as_deref(), line)?,
        args.json,
    )
}
