//! Processes of a vehicle are killed at random while lambdas decide ten times a second: no decision
//! that was durable is lost or appears twice, every gap is marked, and all runs again soon.
//!
//! `GLEANER_KILLS` sets the number of kills; the first random number is printed.

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use gleaner_protocol::vehicle_api::StreamLine;
use gleaner_tests::live::signal;
use gleaner_tests::random::XorShift64;
use gleaner_tests::times;
use gleaner_tests::vehicle::{TestVehicle, text};

use super::ticker;

/// Victims, by a part of their command line; that of a shim also names its runtime.
const VICTIMS: [&str; 6] = [
    "gleaner-orchestrator",
    "gleaner-supervisor",
    "gleaner-shim",
    "gleaner-runtime",
    "start.py",
    "gleaner-ingress",
];
const LAMBDAS: [(&str, &str); 3] = [("rust", "first"), ("rust", "second"), ("python", "third")];

pub fn killed_at_random() {
    let since_1970 = SystemTime::UNIX_EPOCH.elapsed().expect("the clock is set");
    let mut random = XorShift64(since_1970.as_nanos() as u64 | 1);
    println!("random numbers from {}", random.0);
    let mut vehicle = TestVehicle::new();
    vehicle.start();
    let ids = LAMBDAS.map(|(_, name)| name);
    for (language, name) in LAMBDAS {
        let deployed = vehicle.deploy(ticker(language, name).path(), &[]);
        assert!(deployed.status.success(), "{}", text(&deployed));
    }
    let mut seen: BTreeMap<&str, BTreeMap<u64, StreamLine>> = BTreeMap::new();
    let mut recoveries: BTreeMap<&str, Vec<Duration>> = BTreeMap::new();
    for _ in 0..times("GLEANER_KILLS", 24) {
        thread::sleep(Duration::from_millis(random.below(300) as u64));
        let victim = VICTIMS[random.below(VICTIMS.len())];
        // The oracle: these records were durable before the kill.
        for id in ids {
            keep(seen.entry(id).or_default(), vehicle.records(Some(id)));
        }
        let restarts = |vehicle: &TestVehicle| {
            ids.map(|id| vehicle.deployment(id).status.map(|status| status.restarts))
        };
        let before = restarts(&vehicle);
        let started = Instant::now();
        match victim {
            "gleaner-orchestrator" => {
                vehicle.kill_orchestrator();
                thread::sleep(Duration::from_millis(random.below(200) as u64));
                vehicle.start();
            }
            "gleaner-supervisor" => signal(vehicle.supervisor(), "KILL"),
            name => {
                // The ingress of a supervisor that was just started may not run yet.
                let pids = vehicle.until("a victim", |vehicle| {
                    Some(vehicle.processes(name)).filter(|pids| !pids.is_empty())
                });
                signal(pids[random.below(pids.len())], "KILL");
            }
        }
        // A status from before the kill may still show them all running.
        thread::sleep(Duration::from_millis(50));
        vehicle.until_running(&ids);
        recoveries.entry(victim).or_default().push(started.elapsed());
        if victim == "gleaner-orchestrator" {
            assert_eq!(restarts(&vehicle), before, "no lambda is started again");
        }
    }
    let mut lost = 0;
    for id in ids {
        let after = vehicle.records(Some(id));
        let seqs: Vec<_> = after.iter().map(|line| line.seq).collect();
        assert!(seqs.is_sorted_by(|a, b| a < b), "`{id}` has a number twice: {seqs:?}");
        lost += check_gaps(&after);
        let by_seq: BTreeMap<_, _> = after.into_iter().map(|line| (line.seq, line)).collect();
        for (seq, line) in seen.get(id).into_iter().flatten() {
            assert_eq!(by_seq.get(seq), Some(line), "record {seq} of `{id}` was durable");
        }
    }
    for (victim, times) in &mut recoveries {
        times.sort();
        let (median, most) = (times[times.len() / 2], times[times.len() - 1]);
        println!("{victim}: {} kills, all run after {median:.2?}, {most:.2?} at most", times.len());
    }
    let checked: usize = seen.values().map(BTreeMap::len).sum();
    println!("{checked} durable records are unchanged; gaps have {lost} numbers");
    vehicle.stop();
}

/// Adds records that were read; what was read before must not have changed.
fn keep(seen: &mut BTreeMap<u64, StreamLine>, lines: Vec<StreamLine>) {
    // A torn tail becomes a gap with the next writer.
    for line in lines.into_iter().filter(|line| line.kind != "torn" && line.kind != "gap") {
        let before = seen.entry(line.seq).or_insert_with(|| line.clone());
        assert_eq!(*before, line);
    }
}

/// Checks that each number is in a record or in a gap; returns the number of those in gaps.
fn check_gaps(lines: &[StreamLine]) -> u64 {
    let (mut next, mut lost) = (lines.first().map_or(0, |line| line.seq), 0);
    for line in lines {
        assert_eq!(line.seq, next, "a gap is not marked: {line:?}");
        let to = line.record.get("to").and_then(serde_json::Value::as_u64);
        let to = to.filter(|_| line.kind == "gap");
        // The gap record itself has the number after the last missing one.
        next = to.map_or(line.seq + 1, |to| to + 2);
        lost += to.map_or(0, |to| to - line.seq + 1);
    }
    lost
}
