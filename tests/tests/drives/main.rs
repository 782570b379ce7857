//! Results of replays: decisions of the examples, clips, and the state after a crash.
//!
//! Some drives, readers and file systems are not available everywhere; a test that needs one is
//! ignored then, with that reason.

mod cases;
mod clips;
mod crash;
mod examples;

use std::process::ExitCode;

use libtest_mimic::{Arguments, Trial};

fn main() -> ExitCode {
    let of = |file: &'static str, trials: Vec<Trial>| {
        trials.into_iter().map(move |trial| trial.with_kind(file))
    };
    let trials = of("cases", cases::trials())
        .chain(of("clips", clips::trials()))
        .chain(of("crash", crash::trials()))
        .chain(of("examples", examples::trials()));
    libtest_mimic::run(&Arguments::from_args(), trials.collect()).exit_code()
}
