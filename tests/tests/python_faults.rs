//! As `faults.rs`, of a process that is an interpreter. How often its lambda faults is `GLEANER_FAULTS`, and some more.

use gleaner_tests::drive::imu_only;
use gleaner_tests::{Folder, replay, root, times};

/// What the allocator and the kernel may keep, over any number of faults.
const SLACK_BYTES: u64 = 4 << 20;

#[test]
fn a_python_lambda_that_faults_again_and_again_holds_nothing() {
    const IN_A_ROUND: u32 = 3500;
    let rounds = times("GLEANER_FAULTS", IN_A_ROUND).div_ceil(IN_A_ROUND);
    let (folder, lambda) = (Folder::new(), root().join("tests/lambdas/misbehave/python"));
    let run = replay(&lambda, &[imu_only(&folder, rounds.into())], &["--set", "behaviour=error_mostly"]);
    let summary = run.must_exit(gleaner_protocol::Exit::LambdaFaulted.code()).summary.as_ref().expect("a summary");
    let faults = run.decisions.iter().filter(|decision| decision.fault.is_some()).count();
    let said: Vec<u64> = run
        .decisions
        .iter()
        .flat_map(|decision| &decision.triggers)
        .map(|trigger| trigger.attributes["kib"].as_i64().unwrap().unsigned_abs())
        .collect();
    let (early, end) = (said[said.len() / 10], said[said.len() - 1]);
    println!("{faults} faults: {early} KiB resident at most after a tenth, {end} KiB at the end");
    assert!(faults as u32 >= IN_A_ROUND * rounds, "{faults}");
    assert!((end - early) * 1024 < SLACK_BYTES, "from {early} to {end} KiB");
    // Each sample found room, and each wake ran.
    let imu = &summary.topics[0];
    assert_eq!((imu.received, imu.no_slot), (summary.wakes, 0), "{summary:?}");
    assert_eq!((summary.skipped, summary.passed_over), (0, 0), "{summary:?}");
}
