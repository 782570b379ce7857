//! As `host/tests/library/faults.rs`, of a process that is an interpreter. How often its lambda
//! faults is `GLEANER_FAULTS`, and some more.

use gleaner_base::Exit;
use gleaner_lambda::{Decision, FaultKind};
use gleaner_tests::drive::imu_only;
use gleaner_tests::{Copy, Folder, replay, root, times};

/// What the allocator and the kernel may keep, over any number of faults.
const SLACK_BYTES: u64 = 4 << 20;

#[test]
fn a_python_lambda_that_faults_again_and_again_holds_nothing() {
    const IN_A_ROUND: u32 = 3500;
    let rounds = times("GLEANER_FAULTS", IN_A_ROUND).div_ceil(IN_A_ROUND);
    let (folder, lambda) = (Folder::new(), root().join("tests/lambdas/misbehave/python"));
    let run =
        replay(&lambda, &[imu_only(&folder, rounds.into())], &["--set", "behaviour=error_mostly"]);
    let summary = run.must_exit(Exit::LambdaFaulted.code()).summary.as_ref().expect("a summary");
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
    assert_eq!((summary.skipped, summary.backed_off), (0, 0), "{summary:?}");
}

#[test]
fn a_python_lambda_that_takes_more_memory_than_it_may_has_a_fault_with_both_numbers_and_is_made_again()
 {
    const ALLOWED: u64 = 32 << 20;
    // What cannot be told apart is tolerated, and a wake adds to it before it is looked at.
    const AT_MOST: u64 = ALLOWED + (16 << 20) + (12 << 20);
    let lambda = Copy::of("tests/lambdas/misbehave/python", |manifest| {
        manifest.replace("\"256 MiB\"", "\"32 MiB\"")
    });
    let folder = Folder::new();
    let run = replay(lambda.path(), &[imu_only(&folder, 1)], &["--set", "behaviour=hoard"]);
    run.must_exit(Exit::LambdaFaulted.code());
    let faults: Vec<_> =
        run.decisions.iter().filter_map(|decision: &Decision| decision.fault.as_ref()).collect();
    // Each new one comes as far: what it had went with it.
    assert!(faults.len() > 10, "{} faults", faults.len());
    for fault in faults {
        assert_eq!(
            (fault.kind, fault.allowed),
            (FaultKind::Memory, Some(ALLOWED)),
            "{}",
            fault.message
        );
        let used = fault.used.expect("it is known");
        assert!((ALLOWED..AT_MOST).contains(&used), "{}", fault.message);
        assert!(
            fault.message.ends_with("`memory` in [limits] allows 32.0 MiB"),
            "{}",
            fault.message
        );
    }
    let summary = run.summary.as_ref().expect("a summary");
    assert_eq!(summary.backed_off, 0, "there were good wakes between the faults");
}
