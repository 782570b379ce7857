//! `gleaner check DIR`: a built lambda is loaded as on a vehicle and its `init` run, without any
//! sample.

use std::ffi::OsString;

use gleaner_base::{Exit, Failure};

use crate::args::CheckArgs;
use crate::replay::show_result;
use crate::runtime;

/// Checks, and says what was found.
pub(crate) fn run(args: &CheckArgs) -> Result<Exit, Failure> {
    let mut line: Vec<OsString> = vec!["check".into()];
    line.extend(args.asked.settings());
    line.extend(["--".into(), args.asked.lambda.clone().into()]);
    show_result(runtime::run(&args.asked.lambda, line)?, args.json)
}
