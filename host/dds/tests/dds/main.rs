//! Tests of the DDS transport with peers in the same process, in a network namespace.
//!
//! The namespace has nothing but `lo`, so nothing leaves the machine and no other participant is
//! received. Where a namespace cannot be created, every test is ignored and its name gives the
//! reason.

mod discovery;
mod first_sample;
mod graph;
mod hostile;
mod layouts;
mod life;
mod network_namespace;
mod peer;
mod qos;
mod receive;
mod type_query;
mod unsubscribe;
mod write;

use std::process::ExitCode;
use std::sync::{PoisonError, RwLock};

use libtest_mimic::{Arguments, Failed, Trial};

type Test = (&'static str, fn());

/// Held for reading by each test while it runs, and for writing by [`life::ALONE`]: that one checks
/// all threads of this process.
static RUNNING: RwLock<()> = RwLock::new(());

fn main() -> ExitCode {
    let arguments = Arguments::from_args();
    let here = match network_namespace::inside() {
        true => Ok(()),
        false => match network_namespace::rerun() {
            Ok(code) => return code,
            Err(why) => Err(why),
        },
    };
    let tests = [
        type_query::TESTS,
        receive::TESTS,
        qos::TESTS,
        graph::TESTS,
        discovery::TESTS,
        write::TESTS,
        hostile::TESTS,
        layouts::TESTS,
        life::TESTS,
        unsubscribe::TESTS,
        first_sample::TESTS,
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
