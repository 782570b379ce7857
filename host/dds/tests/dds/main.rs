//! The DDS transport against peers in the same process, in a network of their own.
//!
//! All this runs in a network namespace in which there is nothing but `lo`, so that nothing is sent
//! elsewhere and nobody else is heard. Where there may be none, every test is skipped and says so.

mod apart;
mod ask;
mod graph;
mod hostile;
mod life;
mod offers;
mod peer;
mod receive;
mod wire;
mod write;

use std::process::ExitCode;
use std::sync::{PoisonError, RwLock};

use libtest_mimic::{Arguments, Failed, Trial};

type Test = (&'static str, fn());

/// Held by each test while it runs, and by [`life::ALONE`] alone: that one looks at all threads of
/// this process.
static RUNNING: RwLock<()> = RwLock::new(());

fn main() -> ExitCode {
    let arguments = Arguments::from_args();
    let here = match apart::inside() {
        true => Ok(()),
        false => match apart::rerun() {
            Ok(code) => return code,
            Err(why) => Err(why),
        },
    };
    let tests = [
        ask::TESTS,
        receive::TESTS,
        offers::TESTS,
        graph::TESTS,
        wire::TESTS,
        write::TESTS,
        hostile::TESTS,
        life::TESTS,
    ];
    let trial = |&(name, test): &Test| match &here {
        Ok(()) => Trial::test(name, move || -> Result<(), Failed> {
            let is_alone = name == life::ALONE;
            let _alone = is_alone.then(|| RUNNING.write().unwrap_or_else(PoisonError::into_inner));
            let _beside =
                (!is_alone).then(|| RUNNING.read().unwrap_or_else(PoisonError::into_inner));
            test();
            Ok(())
        }),
        Err(why) => Trial::test(format!("{name} [{why}]"), || Ok(())).with_ignored_flag(true),
    };
    let trials = tests.into_iter().flatten().map(trial).collect();
    libtest_mimic::run(&arguments, trials).exit_code()
}
