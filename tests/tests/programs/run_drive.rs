//! Lambdas that run together over a drive: `gleaner run A B --drive FILE`, without a network.

use std::path::{Path, PathBuf};

use gleaner_protocol::{LiveStatus, Report};
use gleaner_tests::live::{RunningProgram, decisions, descendants, run_all, signal, summary};
use gleaner_tests::readers::compare_clips;
use gleaner_tests::{LambdaCopy, TempFolder, replay, root, sample_drive};

/// Exit code for a manifest or a drive that cannot be used.
const USAGE: i32 = 2;
/// Exit code of a run in which the process of a lambda was killed.
const FAULTED: i32 = 6;

/// Exit code for a damaged drive.
const DAMAGED: i32 = 7;

/// IMU samples of the sample drive.
const IMU: u64 = 4170;

fn lambda(name: &str) -> PathBuf {
    root().join(name)
}

fn start(lambdas: &[&LambdaCopy], out: &TempFolder, args: &[&str]) -> RunningProgram {
    let drive = sample_drive();
    let drive = drive.to_str().expect("the checkout has a plain path");
    let lambdas: Vec<&Path> = lambdas.iter().map(|lambda| lambda.path()).collect();
    run_all(&lambdas, out.path(), &[&["--drive", drive], args].concat())
}

/// Waits until a lambda has received samples of the drive.
fn until_it_plays(started: &RunningProgram, name: &str) {
    started.until_named("samples of the drive", |lambda, report| match report {
        Report::Live(live) if lambda == name && live.topics[0].received > 0 => Some(()),
        _ => None,
    });
}

/// Asserts that an IMU lambda that is woken by each sample handled all of the drive.
#[track_caller]
fn handled_all(live: &LiveStatus) {
    let topic = &live.topics[0];
    assert_eq!((topic.received, topic.no_slot, topic.too_big), (IMU, 0, 0), "{live:?}");
    assert_eq!(live.wakes + topic.skipped + live.backed_off, IMU, "{live:?}");
}

#[test]
fn lambdas_over_one_drive_handle_all_of_it_beside_one_that_cannot_start() {
    let lambdas = [
        LambdaCopy::named("examples/hello/rust", "first"),
        LambdaCopy::named("examples/hello/python", "second"),
        LambdaCopy::of("examples/hello/rust", |manifest| {
            manifest.replace("\"hello\"", "\"broken\"").replace("/imu/data", "/imu/dat")
        }),
    ];
    let [first, second, broken] = &lambdas;
    let out = TempFolder::new();
    let args = ["--rate", "4", "--set", "first.brake_mps2=-1.4", "--no-record"];
    let finished = start(&[first, second, broken], &out, &args).finish();
    assert_eq!(finished.status.code(), Some(USAGE), "{}", finished.stderr);
    for name in ["first", "second"] {
        handled_all(&finished.ended_of(name).unwrap());
        handled_all(&summary(&out.path().join(name)));
    }
    let stderr = &finished.stderr;
    assert!(
        stderr.contains("broken: error: cannot start lambda `broken`")
            && stderr.contains("/imu/data")
            && stderr.contains("broken: it could not start; the other lambdas run on"),
        "{stderr}"
    );
    assert!(finished.ended_of("broken").is_none());
    assert!(!out.path().join("broken/summary.json").exists());
    // A setting of one lambda is not applied to the other.
    assert!(!decisions(&out.path().join("first")).is_empty());
    assert!(decisions(&out.path().join("second")).is_empty(), "{stderr}");
}

#[test]
fn a_drive_is_decided_as_in_its_replay_and_its_clips_are_recorded() {
    let (hello, brake_dark) = (
        LambdaCopy::named("examples/hello/python", "hello"),
        LambdaCopy::named("examples/brake-dark/rust", "brake-dark"),
    );
    let out = TempFolder::new();
    let set = ["--set", "hello.brake_mps2=-1.4", "--set", "brake-dark.brake_mps2=-1.4"];
    let finished = start(&[&hello, &brake_dark], &out, &set).finish();
    assert!(finished.status.success(), "{}: {}", finished.status, finished.stderr);
    for (name, copy) in [("hello", &hello), ("brake-dark", &brake_dark)] {
        let replayed = replay(copy.path(), &[sample_drive()], &["--set", "brake_mps2=-1.4"]);
        let labels = |decisions: &[gleaner_lambda::Decision]| {
            let triggers = decisions.iter().flat_map(|decision| &decision.triggers);
            triggers.map(|trigger| trigger.label.clone()).collect::<Vec<_>>()
        };
        let live = decisions(&out.path().join(name));
        // A busy machine may skip frames of the camera.
        if summary(&out.path().join(name)).topics[0].skipped == 0 {
            assert_eq!(labels(&live), replayed.labels(), "{name}: {}", finished.stderr);
        }
    }
    let summary = summary(&out.path().join("hello"));
    handled_all(&summary);
    let recorder = summary.recording.expect("there was a recorder");
    assert!(recorder.recording.clips > 0, "{recorder:?}");
    let imu = recorder.topics.iter().find(|topic| topic.topic == "/imu/data").unwrap();
    assert_eq!((imu.received, imu.no_slot, imu.lost.unwrap_or(0)), (IMU, 0, 0), "{recorder:?}");
    let clips = std::fs::read_to_string(out.path().join("clips.jsonl")).unwrap();
    assert_eq!(clips.lines().count() as u64, recorder.recording.clips, "{clips}");
    compare_clips(out.path(), &[sample_drive()]);
}

#[test]
fn the_results_up_to_the_damage_of_a_drive_are_kept() {
    let lambda = LambdaCopy::named("examples/hello/rust", "hello");
    let out = TempFolder::new();
    let whole = std::fs::read(sample_drive()).unwrap();
    let cut = out.write("cut.mcap", &whole[..whole.len() / 4]);
    let args = ["--drive", cut.to_str().unwrap(), "--rate", "4", "--no-record"];
    let finished = run_all(&[lambda.path()], out.path(), &args).finish();
    assert_eq!(finished.status.code(), Some(DAMAGED), "{}", finished.stderr);
    assert!(finished.stderr.contains("the drive is damaged: "), "{}", finished.stderr);
    let ended = finished.ended();
    assert!((1..IMU).contains(&ended.topics[0].received), "{ended:?}");
    assert_eq!(ended.wakes + ended.topics[0].skipped, ended.topics[0].received, "{ended:?}");
    assert_eq!(ended.restarts, 0);
}

#[test]
fn a_topic_that_the_drive_lacks_ends_the_run_of_a_single_lambda() {
    let lambda =
        LambdaCopy::of("examples/hello/rust", |manifest| manifest.replace("/imu/data", "/imu/dat"));
    let out = TempFolder::new();
    let finished = start(&[&lambda], &out, &["--no-record"]).finish();
    assert_eq!(finished.status.code(), Some(USAGE), "{}", finished.stderr);
    let stderr = &finished.stderr;
    assert!(
        stderr.contains("`/imu/dat`") && stderr.contains("`/imu/data`") && stderr.contains("help:"),
        "{stderr}"
    );
}

#[test]
fn a_killed_lambda_is_restarted_alone_and_the_others_lose_nothing() {
    let (kept, killed) = (
        LambdaCopy::named("examples/hello/rust", "kept"),
        LambdaCopy::named("examples/hello/rust", "killed"),
    );
    let out = TempFolder::new();
    let started = start(&[&kept, &killed], &out, &["--rate", "4", "--no-record"]);
    until_it_plays(&started, "killed");
    let folder = killed.path().to_str().unwrap();
    let runtime = *descendants(started.pid(), folder).last().expect("it runs");
    signal(runtime, "KILL");
    started.until_named("its next process", |name, report| match report {
        Report::Ready => {
            assert_eq!(name, "killed");
            Some(())
        }
        _ => None,
    });
    let finished = started.finish();
    assert_eq!(finished.status.code(), Some(FAULTED), "{}", finished.stderr);
    let stderr = &finished.stderr;
    assert!(
        stderr.contains(
            "killed: the lambda's process was ended by signal 9 (SIGKILL); restarting in 1 s"
        ),
        "{stderr}"
    );
    let (kept, killed) = (finished.ended_of("kept").unwrap(), finished.ended_of("killed").unwrap());
    handled_all(&kept);
    assert_eq!((kept.restarts, killed.restarts), (0, 1));
    assert!((1..IMU).contains(&killed.topics[0].received), "{killed:?}");
    let both = summary(&out.path().join("killed"));
    assert!(both.wakes > killed.wakes && both.faults == killed.faults + 1, "{both:?}");
}

#[test]
fn ctrl_c_during_a_drive_ends_all_lambdas_with_their_results() {
    let (first, second) = (
        LambdaCopy::named("examples/hello/rust", "first"),
        LambdaCopy::named("examples/hello/python", "second"),
    );
    let out = TempFolder::new();
    let started = start(&[&first, &second], &out, &[]);
    until_it_plays(&started, "second");
    let finished = started.interrupt();
    assert!(finished.status.success(), "{}: {}", finished.status, finished.stderr);
    for name in ["first", "second"] {
        let ended = finished.ended_of(name).unwrap();
        let topic = &ended.topics[0];
        assert!((1..IMU).contains(&topic.received), "{ended:?}");
        assert_eq!(summary(&out.path().join(name)).wakes, ended.wakes);
    }
}

#[test]
fn two_lambdas_of_one_name_are_refused() {
    let out = TempFolder::new();
    let twins = [lambda("examples/hello/rust"), lambda("examples/hello/python")];
    let finished = run_all(&[&twins[0], &twins[1]], out.path(), &[]).finish();
    assert_eq!(finished.status.code(), Some(USAGE), "{}", finished.stderr);
    assert!(finished.stderr.contains("are both named `hello`"), "{}", finished.stderr);
    assert!(std::fs::read_dir(out.path()).unwrap().next().is_none(), "nothing is written");
}
