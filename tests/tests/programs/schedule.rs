//! Ticks of lambdas over a drive, in both languages. `host/tests/library/schedule.rs` tests wakes
//! by samples.

use std::path::PathBuf;

use gleaner_lambda::{Cause, Decision, twins_differ};
use gleaner_tests::drive::{CdrBuilder, TICKER_IMU, one_topic};
use gleaner_tests::{ReplayRun, TempFolder, replay, root, sample_drive};

const MS: i64 = 1_000_000;
const PERIOD: i64 = 100 * MS;

/// Runs both twins of `ticker` over a drive; they must agree, also in attributes besides the score.
fn tick(drive: PathBuf) -> ReplayRun {
    let [rust, python] = ["rust", "python"].map(|kind| {
        let lambda = root().join("tests/lambdas/ticker").join(kind);
        replay(&lambda, std::slice::from_ref(&drive), &["--all"])
    });
    assert_eq!(rust.must_exit(0).decisions.len(), python.must_exit(0).decisions.len());
    for (a, b) in rust.decisions.iter().zip(&python.decisions) {
        assert_eq!(twins_differ(a, b), None);
        assert_eq!(a.triggers[0].attributes, b.triggers[0].attributes);
    }
    rust
}

fn attribute(decision: &Decision, name: &str) -> i64 {
    decision.triggers[0].attributes[name].as_i64().unwrap()
}

#[test]
fn the_twins_tick_every_100_ms_of_the_drive() {
    let run = tick(sample_drive());
    assert_eq!(run.decisions.len(), 399);
    for decision in &run.decisions {
        assert_eq!((decision.cause, decision.triggers.len()), (Cause::Tick, 1));
        assert_eq!((&decision.input, &decision.topic, decision.seq), (&None, &None, None));
        assert_eq!((attribute(decision, "at"), attribute(decision, "missed")), (decision.at_ns, 0));
    }
    assert!(run.decisions.windows(2).all(|pair| pair[1].at_ns - pair[0].at_ns == PERIOD));
    // A tick reads the data of the drive: the car brakes.
    assert!(run.decisions.iter().any(|decision| decision.triggers[0].score.unwrap() < -1.0));
}

#[test]
fn all_ticks_of_a_gap_too_long_to_catch_up_are_counted_as_missed() {
    let folder = TempFolder::new();
    // A gap of eight hours and 50 ms.
    let [before, after] = [1_000 * MS, 30_000_050 * MS];
    let messages = [0, before, after, after + 1_000 * MS].map(|at_ns| {
        // The header, and three numbers from the next multiple of 8.
        let mut cdr = CdrBuilder::header().done();
        cdr.resize(cdr.len().next_multiple_of(8), 0);
        cdr.extend([0.5_f64, 0.0, 9.8].iter().flat_map(|value| value.to_le_bytes()));
        (at_ns as u64, cdr)
    });
    let run = tick(one_topic(&folder, "/imu/data", "sensor_msgs/msg/Imu", TICKER_IMU, &messages));
    let summary = run.summary.as_ref().unwrap();
    // From the tick at 1.0 s to the one at 30,000.0 s.
    let missed = (after - before) / PERIOD + 1;
    assert_eq!(missed, 299_991);
    assert_eq!(summary.missed_ticks, missed as u64);
    let reported: Vec<_> = run
        .decisions
        .iter()
        .map(|decision| attribute(decision, "missed"))
        .filter(|n| *n != 0)
        .collect();
    assert_eq!(reported, [missed]);
    let (early, late): (Vec<_>, Vec<_>) =
        run.decisions.iter().partition(|decision| decision.at_ns < before);
    assert_eq!((early.len(), late.len()), (9, 10));
    assert!(attribute(late[0], "missed") == missed && late[0].at_ns > after);
}
