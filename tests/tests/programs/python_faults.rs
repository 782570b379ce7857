//! As `host/tests/library/faults.rs`, for a Python lambda. `GLEANER_FAULTS` sets the number of
//! faults, rounded up.

use gleaner_base::Exit;
use gleaner_lambda::{Decision, FaultKind};
use gleaner_tests::drive::imu_only;
use gleaner_tests::{LambdaCopy, TempFolder, replay, root, times};

/// Growth that the allocator and the kernel may cause, independent of the number of faults.
const SLACK_BYTES: u64 = 4 << 20;

#[test]
fn a_python_lambda_that_faults_repeatedly_leaks_nothing() {
    const FAULTS_PER_ROUND: u32 = 3500;
    let rounds = times("GLEANER_FAULTS", FAULTS_PER_ROUND).div_ceil(FAULTS_PER_ROUND);
    let (folder, lambda) = (TempFolder::new(), root().join("tests/lambdas/misbehave/python"));
    let run =
        replay(&lambda, &[imu_only(&folder, rounds.into())], &["--set", "behaviour=error_mostly"]);
    let summary = run.must_exit(Exit::LambdaFaulted.code()).summary.as_ref().expect("a summary");
    let faults = run.decisions.iter().filter(|decision| decision.fault.is_some()).count();
    let reported: Vec<u64> = run
        .decisions
        .iter()
        .flat_map(|decision| &decision.triggers)
        .map(|trigger| trigger.attributes["kib"].as_i64().unwrap().unsigned_abs())
        .collect();
    let (early, end) = (reported[reported.len() / 10], reported[reported.len() - 1]);
    println!("{faults} faults: {early} KiB resident at most after a tenth, {end} KiB at the end");
    assert!(faults as u32 >= FAULTS_PER_ROUND * rounds, "{faults}");
    assert!((end - early) * 1024 < SLACK_BYTES, "from {early} to {end} KiB");
    // Each sample found a slot, and each wake ran.
    let imu = &summary.topics[0];
    assert_eq!((imu.received, imu.no_slot), (summary.wakes, 0), "{summary:?}");
    assert_eq!((summary.skipped, summary.backed_off), (0, 0), "{summary:?}");
}

#[test]
fn a_python_lambda_over_its_memory_limit_faults_with_both_numbers_and_is_re_initialised() {
    const ALLOWED: u64 = 32 << 20;
    // Some memory cannot be attributed and is tolerated, and a wake may exceed the limit before the
    // check.
    const AT_MOST: u64 = ALLOWED + (16 << 20) + (12 << 20);
    let lambda = LambdaCopy::of("tests/lambdas/misbehave/python", |manifest| {
        manifest.replace("\"256 MiB\"", "\"32 MiB\"")
    });
    let folder = TempFolder::new();
    let run = replay(lambda.path(), &[imu_only(&folder, 1)], &["--set", "behaviour=hoard"]);
    run.must_exit(Exit::LambdaFaulted.code());
    let faults: Vec<_> =
        run.decisions.iter().filter_map(|decision: &Decision| decision.fault.as_ref()).collect();
    // Each new instance gets as far: the memory of the previous one was freed.
    assert!(faults.len() > 10, "{} faults", faults.len());
    for fault in faults {
        assert_eq!(
            (fault.kind, fault.allowed),
            (FaultKind::Memory, Some(ALLOWED)),
            "{}",
            fault.message
        );
        let used = fault.used.expect("the amount is known");
        assert!((ALLOWED..AT_MOST).contains(&used), "{}", fault.message);
        let message = &fault.message;
        assert!(message.ends_with("`memory` in [limits] allows 32.0 MiB"), "{message}");
    }
    let summary = run.summary.as_ref().expect("a summary");
    assert_eq!(summary.backed_off, 0, "some wakes between the faults succeeded");
}
