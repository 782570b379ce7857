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
mod peer;
mod qos;
mod receive;
mod type_query;
mod unsubscribe;
mod write;

use std::process::ExitCode;
use std::sync::{PoisonError, RwLock};

use gleaner_test_support::network_namespace::{self, Test};

/// Held for reading by each test while it runs, and for writing by [`life::ALONE`]: that one checks
/// all threads of this process.
static RUNNING: RwLock<()> = RwLock::new(());

fn main() -> ExitCode {
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
    network_namespace::run_tests(tests.into_iter().flatten().copied(), run)
}

fn run((name, test): Test) {
    let is_alone = name == life::ALONE;
    let _alone = is_alone.then(|| RUNNING.write().unwrap_or_else(PoisonError::into_inner));
    let _beside = (!is_alone).then(|| RUNNING.read().unwrap_or_else(PoisonError::into_inner));
    test();
}
