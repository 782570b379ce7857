//! Lambdas without a player: most are woken by a clock.

use gleaner_lambda::FaultKind;
use gleaner_protocol::Report;
use gleaner_tests::live::{JsonReport, decisions, descendants, run, signal, summary};
use gleaner_tests::{LambdaCopy, TempFolder};

use crate::{lambda, wait_for};

pub fn ends_with(parent: Option<&str>) {
    let out = TempFolder::new();
    let started = run(&lambda("examples/hello", "python"), out.path(), &["--no-record"]);
    started.until_ready();
    let left = descendants(started.pid(), "start.py");
    assert_eq!(left.len(), 1);
    let starter = parent.map_or(started.pid(), |name| descendants(started.pid(), name)[0]);
    signal(starter, "KILL");
    // A process that has ended has no command line, even before it is waited for.
    let line = format!("/proc/{}/cmdline", left[0]);
    wait_for("the end of the lambda's process", || {
        std::fs::read(&line).unwrap_or_default().is_empty()
    });
}

pub fn every_wake() {
    for language in ["rust", "python"] {
        let lambda = LambdaCopy::of(&format!("tests/lambdas/attack/{language}"), |manifest| {
            manifest.replace("\"20ms\"", "\"1ms\"")
        });
        let out = TempFolder::new();
        let started = run(lambda.path(), out.path(), &["--no-record", "--all"]);
        started.until_live("some thousand wakes", |live| live.wakes >= 3000);
        let finished = started.interrupt();
        let (ended, written) = (finished.ended(), decisions(out.path()));
        assert_eq!(
            (written.len() as u64, ended.unwritten),
            (ended.wakes, 0),
            "{}",
            finished.stderr
        );
        assert!(written.is_sorted_by(|a, b| a.at_ns < b.at_ns));
        let summary = summary(out.path());
        assert_eq!((summary.wakes, summary.unwritten), (ended.wakes, 0));
    }
}

pub fn killed_at_once() {
    let lambda = LambdaCopy::of("tests/lambdas/ticker/python", |manifest| {
        manifest.replace("\"100ms\"", "\"1ms\"")
    });
    let out = TempFolder::new();
    let started = run(lambda.path(), out.path(), &["--no-record"]);
    started.until_ready();
    let process = descendants(started.pid(), "start.py")[0];
    let mut reported = Vec::new();
    started.until("the end of the process", |line| {
        let JsonReport::Lambda(Report::Decision(decision)) = line else { return None };
        if reported.is_empty() {
            signal(process, "KILL");
        }
        let is_killed =
            decision.fault.as_ref().is_some_and(|fault| fault.kind == FaultKind::Killed);
        reported.push(*decision);
        is_killed.then_some(())
    });
    let written = decisions(out.path());
    assert!(
        reported.len() > 1 && reported.iter().all(|decision| written.contains(decision)),
        "{reported:?}, written {written:?}"
    );
    started.until_live("the next process", |live| live.restarts == 1);
    let finished = started.interrupt();
    assert!(finished.stderr.contains("was ended by signal 9"), "{}", finished.stderr);
    // The killed process could not count its last wake.
    assert_eq!(summary(out.path()).faults, finished.ended().faults + 1);
}

pub fn stopped() {
    const DECISIONS: &str = "/reported";
    let writer = LambdaCopy::of("tests/lambdas/ticker/rust", |manifest| {
        manifest.replace("\"100ms\"", "\"1ms\"")
    });
    let reader = LambdaCopy::of("bench/lambdas/imu/rust", |manifest| {
        manifest
            .replace("/imu/synthetic", DECISIONS)
            .replace("sensor_msgs/msg/Imu", "std_msgs/msg/String")
    });
    let (reported, received) = (TempFolder::new(), TempFolder::new());
    let writing = run(writer.path(), reported.path(), &["--no-record", "--decisions", DECISIONS]);
    let reading = run(reader.path(), received.path(), &["--no-record"]);
    reading.until_live("decisions", |live| live.topics[0].received > 0);
    let stopped = descendants(reading.pid(), "gleaner-ingress")[0];
    signal(stopped, "STOP");
    let from = writing.until_live("unsent decisions", |live| live.unsent > 0);
    let to = writing.until_live("another second", |live| live.up_s > from.up_s + 1.0);
    signal(stopped, "CONT");
    // 1,000 a second are due; if the lambda waited for the reader, it would be 10.
    let rate = (to.wakes - from.wakes) as f64 / (to.up_s - from.up_s);
    assert!(
        rate > 50.0 && to.unsent > from.unsent,
        "{rate} wakes per second, {} not sent",
        to.unsent
    );
    writing.signal("INT");
    assert!(writing.finish().ended().unsent >= to.unsent);
    reading.interrupt();
}

pub fn no_writer() {
    let out = TempFolder::new();
    let started = run(&lambda("examples/hello", "rust"), out.path(), &["--for", "5"]);
    let finished = started.finish();
    assert!(finished.status.success(), "{}", finished.stderr);
    let stderr = &finished.stderr;
    assert!(stderr.contains("no writer of `/imu/data` (sensor_msgs/msg/Imu) yet"), "{stderr}");
    assert_eq!(finished.ended().topics[0].received, 0);
}
