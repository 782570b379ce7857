//! Processes of a vehicle are killed at random while lambdas decide, record and run models: no
//! decision or clip that was durable is lost or appears twice, every gap is marked, and all runs
//! again soon.
//!
//! `GLEANER_KILLS` sets the number of kills; the first random number is printed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use gleaner_protocol::vehicle_api::{StreamLine, VehicleStatus};
use gleaner_test_support::random::XorShift64;
use gleaner_tests::live::{no_player, play, signal};
use gleaner_tests::vehicle::TestVehicle;
use gleaner_tests::{LambdaCopy, times};

use super::{clips, recording, ticker};

/// Victims, by a part of their command line; that of a shim also names its runtime.
const VICTIMS: [&str; 8] = [
    "gleaner-orchestrator",
    "gleaner-supervisor",
    "gleaner-shim",
    "gleaner-runtime",
    "start.py",
    "gleaner-ingress",
    "gleaner-recorder",
    "gleaner-inference",
];
/// Victims whose end ends no lambda.
const SERVICES: [&str; 4] =
    ["gleaner-orchestrator", "gleaner-ingress", "gleaner-recorder", "gleaner-inference"];
/// Lambdas that decide ten times a second. The first and the third record, too.
const TICKERS: [&str; 3] = ["first", "second", "third"];
const IDS: [&str; 4] = ["first", "second", "third", "detector"];

pub fn killed_at_random() {
    let since_1970 = SystemTime::UNIX_EPOCH.elapsed().expect("the clock is set");
    let mut random = XorShift64(since_1970.as_nanos() as u64 | 1);
    println!("random numbers from {}", random.0);
    let mut vehicle = TestVehicle::started();
    let lambdas = [
        recording("rust", "first"),
        ticker("rust", "second"),
        recording("python", "third"),
        detector(),
    ];
    for lambda in &lambdas {
        vehicle.deploys(lambda.path());
    }
    // Without it, clips hold journals only.
    if let Some(why) = no_player() {
        println!("no samples: {why}");
    }
    let player = no_player()
        .is_none()
        .then(|| play(&["--imu", "50", "--synthetic", "160x120@2", "--wait", "1"]));
    vehicle.until("all processes", |vehicle| runs(vehicle).then_some(()));
    let mut seen: BTreeMap<&str, BTreeMap<u64, StreamLine>> = BTreeMap::new();
    let mut listed = BTreeSet::new();
    let mut recoveries: BTreeMap<&str, Vec<Duration>> = BTreeMap::new();
    for _ in 0..times("GLEANER_KILLS", 24) {
        thread::sleep(Duration::from_millis(random.below(300) as u64));
        let victim = VICTIMS[random.below(VICTIMS.len())];
        // The oracle: these records and clips were durable before the kill.
        for id in TICKERS {
            keep(seen.entry(id).or_default(), vehicle.records(Some(id)));
        }
        listed.extend(clips(&vehicle).into_iter().map(|clip| clip.file));
        let before = restarts(&vehicle);
        let started = Instant::now();
        kill(&mut vehicle, victim, &mut random);
        // The status may be that of a moment before.
        thread::sleep(Duration::from_millis(50));
        vehicle.until("all processes", |vehicle| runs(vehicle).then_some(()));
        recoveries.entry(victim).or_default().push(started.elapsed());
        if SERVICES.contains(&victim) {
            assert_eq!(restarts(&vehicle), before, "{victim}: no lambda is started again");
        }
    }
    if let Some(player) = player {
        player.interrupt();
    }
    for (victim, times) in &mut recoveries {
        times.sort();
        let at = |share: f64| times[((times.len() - 1) as f64 * share).round() as usize];
        let [median, p99, most] = [0.5, 0.99, 1.0].map(at);
        println!(
            "{victim}: {} kills, all run after {median:.2?} (p50), {p99:.2?} (p99), {most:.2?} \
             (max)",
            times.len()
        );
    }
    let mut lost = 0;
    for id in TICKERS {
        let after = vehicle.records(Some(id));
        let seqs: Vec<_> = after.iter().map(|line| line.seq).collect();
        assert!(seqs.is_sorted_by(|a, b| a < b), "`{id}` has a number twice: {seqs:?}");
        lost += check_gaps(&after);
        // In a long run, the oldest records make room for new ones, with a gap record.
        let removed: Vec<_> = after
            .iter()
            .filter(|line| line.kind == "gap" && line.record["reason"] == "Budget")
            .map(|line| line.seq..=line.record["to"].as_u64().expect("an end"))
            .collect();
        let by_seq: BTreeMap<_, _> = after.into_iter().map(|line| (line.seq, line)).collect();
        let is_removed = |seq: &u64| removed.iter().any(|numbers| numbers.contains(seq));
        let durable = seen.get(id).into_iter().flatten();
        for (seq, line) in durable.filter(|(seq, _)| !is_removed(seq)) {
            assert_eq!(by_seq.get(seq), Some(line), "record {seq} of `{id}` was durable");
        }
    }
    let checked: usize = seen.values().map(BTreeMap::len).sum();
    println!("{checked} durable records are unchanged; gaps have {lost} numbers");
    let status = vehicle.status();
    vehicle.stop();
    check_clips(&vehicle, &status, &listed);
}

/// Kills a process of `victim`, and waits until another one has taken its place.
fn kill(vehicle: &mut TestVehicle, victim: &str, random: &mut XorShift64) {
    match victim {
        "gleaner-orchestrator" => {
            vehicle.kill_orchestrator();
            thread::sleep(Duration::from_millis(random.below(200) as u64));
            vehicle.start();
        }
        "gleaner-supervisor" => {
            let pid = vehicle.supervisor();
            signal(pid, "KILL");
            vehicle.until("another one", |vehicle| (vehicle.supervisor() != pid).then_some(()));
        }
        name => {
            let pids = vehicle.until("a victim", |vehicle| {
                Some(vehicle.processes(name)).filter(|pids| !pids.is_empty())
            });
            signal(pids[random.below(pids.len())], "KILL");
            vehicle.until("another one", |vehicle| {
                vehicle.processes(name).iter().any(|pid| !pids.contains(pid)).then_some(())
            });
        }
    }
}

/// Returns the example with a model, on the images of the player.
fn detector() -> LambdaCopy {
    LambdaCopy::changed_and_named("examples/yolo-detector/rust", "detector", |manifest| {
        let manifest = manifest
            .replace("/camera/front/compressed", "/camera/synthetic/image_raw")
            .replace("CompressedImage", "Image");
        let (before, record) = manifest.split_once("[record]").expect("it records");
        let (_, after) = record.split_once("[limits]").expect("it has limits");
        format!("{before}[limits]{after}")
    })
}

/// Returns whether all lambdas run, and the processes that they share.
fn runs(vehicle: &TestVehicle) -> bool {
    let Some(status) = vehicle.try_status() else { return false };
    let Some(supervisor) = &status.supervisor else { return false };
    supervisor.ingress.is_ready
        && supervisor.recorder.as_ref().is_some_and(|it| it.is_ready)
        && supervisor.inference.as_ref().is_some_and(|it| it.is_ready)
        && TestVehicle::all_run(&status, &IDS)
}

fn restarts(vehicle: &TestVehicle) -> [Option<u32>; 4] {
    IDS.map(|id| vehicle.deployment(id).status.map(|status| status.restarts))
}

/// Checks that the clips that were listed before are still there, none is listed twice, and the
/// signature of the vehicle covers each.
fn check_clips(vehicle: &TestVehicle, status: &VehicleStatus, before: &BTreeSet<PathBuf>) {
    let clips = clips(vehicle);
    let files: BTreeSet<_> = clips.iter().map(|clip| clip.file.clone()).collect();
    assert_eq!(files.len(), clips.len(), "a clip is listed twice");
    assert!(before.is_subset(&files), "{before:?} were listed; now {files:?}");
    let trusted = vehicle.path("vehicles");
    let line = format!("{} {}\n", status.vehicle, status.key);
    std::fs::write(&trusted, line).expect("a file is written");
    let trusted = trusted.to_str().expect("a plain path");
    for file in &files {
        let file = vehicle.path("state/clips").join(file);
        vehicle.succeeds(&["verify", file.to_str().expect("a plain path"), "--trust", trusted]);
    }
    let recovered = clips.iter().filter(|clip| clip.recovered.is_some()).count();
    println!("{} signed clips, of which {recovered} were recovered", clips.len());
    assert!(!clips.is_empty());
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
