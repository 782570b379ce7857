//! Lambdas on live topics: `gleaner run` with the recorder and the player, each case in a private
//! network.
//!
//! `GLEANER_ROUNDS` sets how often a drive is played and compared with its replay; the default is
//! once.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use gleaner_lambda::{Clip, Decision, FaultKind};
use gleaner_protocol::link::RecorderReport;
use gleaner_protocol::{LiveStatus, Report};
use gleaner_tests::live::{
    self, JsonReport, RunningProgram, decisions, descendants, no_player, play, run, signal,
};
use gleaner_tests::{LambdaCopy, TempFolder, namespace, replay_to, root, sample_drive, times};
use libtest_mimic::{Arguments, Trial};

/// Environment variable with the case that this process runs in its private network.
const CASE: &str = "GLEANER_LIVE_CASE";

type LiveCase = (&'static str, fn());

/// Cases with a player.
const PLAYED: &[LiveCase] = &[
    ("a_drive_played_live_is_decided_as_in_its_replay", as_in_replay),
    ("a_lambda_slower_than_its_camera_gets_the_newest_frame_and_skips_are_counted", || {
        slow("sleep")
    }),
    (
        "a_lambda_that_keeps_every_frame_does_not_stop_the_reception_and_refusals_are_counted",
        || slow("keep"),
    ),
    ("ctrl_c_stops_the_run_and_closes_open_clips", ctrl_c),
    ("a_lambda_whose_process_is_killed_is_started_again_and_loses_no_decision", || {
        killed("start.py")
    }),
    ("a_recorder_that_is_killed_is_started_again_and_its_clip_recovered", || {
        killed("gleaner-recorder")
    }),
];

/// Cases with lambdas only.
const ALONE: &[LiveCase] = &[
    ("a_topic_without_a_writer_is_reported", no_writer),
    ("a_stopped_reader_of_decisions_does_not_block_the_lambda", stopped),
    ("a_lambda_does_not_outlive_the_command_that_started_it", || ends_with(None)),
    ("a_lambda_does_not_outlive_its_shim", || ends_with(Some("gleaner-shim"))),
    ("every_wake_at_1_khz_is_written_with_all", every_wake),
    ("reported_decisions_are_in_the_file_even_if_the_process_is_killed", killed_at_once),
];

fn main() -> ExitCode {
    if let Ok(name) = std::env::var(CASE) {
        let (_, case) = PLAYED
            .iter()
            .chain(ALONE)
            .find(|(case, _)| *case == name)
            .expect("a case of this suite");
        case();
        return ExitCode::SUCCESS;
    }
    let trial = |(name, _): &LiveCase, missing: Option<&str>| {
        let name = *name;
        let run = move || namespace::case(CASE, name);
        match missing {
            Some(why) => Trial::test(format!("{name} [{why}]"), run).with_ignored_flag(true),
            None => Trial::test(name, run),
        }
    };
    let mut arguments = Arguments::from_args();
    // Cases that run at the same time would make each other skip samples.
    arguments.test_threads = Some(1);
    let (no_network, no_player) = (namespace::unavailable(), no_player());
    let played = PLAYED.iter().map(|case| trial(case, no_network.or(no_player)));
    let trials = played.chain(ALONE.iter().map(|case| trial(case, no_network))).collect();
    libtest_mimic::run(&arguments, trials).exit_code()
}

fn lambda(name: &str, language: &str) -> PathBuf {
    root().join(name).join(language)
}

/// A copy of a lambda with a generous deadline: a fault would discard its state, and these cases do
/// not test deadlines.
fn with_long_deadline(lambda: &str) -> LambdaCopy {
    let line = |line: &str| {
        if line.starts_with("deadline") { "deadline = \"5s\"" } else { line }.to_owned()
    };
    LambdaCopy::of(lambda, |manifest| manifest.lines().map(line).collect::<Vec<_>>().join("\n"))
}

/// A trigger: its label, and the sequence number of the sample of the camera or IMU that caused it.
type TriggerKey = (String, Option<u64>);

/// The triggers of decisions.
fn trigger_keys(decisions: &[Decision]) -> Vec<TriggerKey> {
    let of = |decision: &Decision| {
        let seq = decision.seq;
        decision
            .triggers
            .iter()
            .map(move |trigger| (trigger.label.clone(), seq))
            .collect::<Vec<_>>()
    };
    decisions.iter().flat_map(of).collect()
}

/// Returns whether the labels are the same, for the same camera samples and nearly the same IMU
/// samples.
///
/// Both lambdas use half a second of the IMU by receive stamps. Live, these jitter by a millisecond
/// and more, so that a sample at the edge is in or out; a threshold may then be crossed some
/// samples earlier or later. A frame of the camera is 10 of them. Skipped samples add as many.
fn agrees(live: &[TriggerKey], replay: &[TriggerKey], skipped: u64) -> bool {
    let is_camera = replay.iter().all(|(label, _)| label == "brake-dark");
    let slack = skipped + if is_camera { 0 } else { 10 };
    let same = |((a, n), (b, m)): (&TriggerKey, &TriggerKey)| {
        a == b && n.zip(*m).is_some_and(|(n, m)| n.abs_diff(m) <= slack)
    };
    live.len() == replay.len() && live.iter().zip(replay).all(same)
}

fn lost(ended: &LiveStatus) -> u64 {
    ended
        .topics
        .iter()
        .map(|topic| topic.lost.expect("DDS counts losses") + topic.no_slot + topic.malformed)
        .sum()
}

/// A busy machine may stall for longer than the jitter of a window. Drives with differences are
/// played again; differences that repeat are failures.
fn as_in_replay() {
    /// Maximum attempts until a lambda decides as in its replay.
    const TRIES: usize = 6;
    let set = ["--set", "brake_mps2=-1.4"];
    let names = ["hello/rust", "hello/python", "brake-dark/rust", "brake-dark/python"];
    let lambdas = names.map(|name| with_long_deadline(&format!("examples/{name}")));
    let drive = sample_drive();
    let replayed = |lambda: &LambdaCopy| {
        let out = TempFolder::new();
        let replayed = replay_to(out.path(), lambda.path(), std::slice::from_ref(&drive), &set);
        let expected = trigger_keys(&replayed.decisions);
        assert!(!expected.is_empty(), "{}", replayed.stderr);
        (lambda.path().to_owned(), expected)
    };
    let expected: Vec<_> = lambdas.iter().map(replayed).collect();
    for round in 1..=times("GLEANER_ROUNDS", 1) {
        let mut failing = names.to_vec();
        let mut differences = Vec::new();
        for _ in 0..TRIES {
            for (name, found) in names.into_iter().zip(played(&drive, &set, &expected)) {
                match found {
                    Some(difference) => differences.push(format!("{name}: {difference}")),
                    None => failing.retain(|other| *other != name),
                }
            }
            if failing.is_empty() {
                break;
            }
        }
        println!("round {round}: {} differences {differences:#?}", differences.len());
        assert!(
            failing.is_empty(),
            "round {round}: different from the replay in {TRIES} attempts: {differences:#?}"
        );
    }
}

/// Plays the drive to these lambdas together; returns for each how its decisions differ from the
/// replay.
fn played(
    drive: &Path,
    set: &[&str; 2],
    lambdas: &[(PathBuf, Vec<TriggerKey>)],
) -> Vec<Option<String>> {
    let args = [set[0], set[1], "--no-record"];
    let outs: Vec<TempFolder> = lambdas.iter().map(|_| TempFolder::new()).collect();
    let runs: Vec<RunningProgram> = lambdas
        .iter()
        .zip(&outs)
        .map(|((lambda, _), out)| run(lambda, out.path(), &args))
        .collect();
    runs.iter().for_each(RunningProgram::until_ready);
    let path = drive.to_str().expect("the checkout has a plain path");
    let played =
        play(&[path, "--wait", "2", "--topics", "/imu/data,/camera/front/compressed"]).finish();
    assert!(played.status.success(), "{}", played.stderr);
    // The last sample may be in transit, and windows are open for some seconds after it.
    for started in &runs {
        started.until_live("the end of the drive", |live| {
            let is_over =
                live.topics.iter().all(|topic| topic.writers == Some(0) && topic.received > 0);
            // Each sample of the event input was handled: one of the topics causes the wakes.
            is_over && live.topics.iter().any(|topic| live.wakes + topic.skipped == topic.received)
        });
        started.signal("INT");
    }
    let compared = |((started, out), (_, expected)): (
        (RunningProgram, &TempFolder),
        &(PathBuf, Vec<TriggerKey>),
    )| {
        let finished = started.finish();
        assert!(finished.status.success(), "{}, {}", finished.status, finished.stderr);
        let ended = finished.ended();
        assert_eq!(ended.faults, 0, "{}", finished.stderr);
        let live = trigger_keys(&decisions(out.path()));
        if lost(&ended) == 0 && agrees(&live, expected, ended.skipped) {
            return None;
        }
        Some(format!(
            "{} skipped, {} lost: {live:?}, in the replay {expected:?}",
            ended.skipped,
            lost(&ended)
        ))
    };
    runs.into_iter().zip(&outs).zip(lambdas).map(compared).collect()
}

/// Number of frames that the player sends: 6 s.
const FRAMES: u64 = 180;

fn slow(behaviour: &str) {
    // A busy machine may lose frames before the first one that arrives, which are not counted; then
    // they are played again.
    let is_whole = (0..3).any(|_| slow_round(behaviour));
    assert!(is_whole, "frames were lost before the first that arrived, each time");
}

/// Plays frames to lambdas that are slow, or keep them. Returns whether all frames are counted.
fn slow_round(behaviour: &str) -> bool {
    let outs = [TempFolder::new(), TempFolder::new()];
    let set = format!("behaviour={behaviour}");
    let start = |(language, out): (&str, &TempFolder)| {
        run(&lambda("tests/lambdas/slow", language), out.path(), &["--all", "--set", &set])
    };
    let runs: Vec<RunningProgram> = ["rust", "python"].into_iter().zip(&outs).map(start).collect();
    runs.iter().for_each(RunningProgram::until_ready);
    let player = play(&["--synthetic", "640x480@30", "--wait", "2", "--duration", "6"]).finish();
    assert!(player.status.success(), "{}", player.stderr);
    let compared = |(started, out): (RunningProgram, &TempFolder)| {
        let mut before = None;
        // Frames may be in transit when the player has ended.
        started.until_live("the end of the frames", |live| {
            let topic = &live.topics[0];
            let is_over = topic.writers == Some(0) && topic.received > 0;
            let now = (topic.received, topic.no_slot, topic.lost);
            is_over && before.replace(now) == Some(now)
        });
        started.signal("INT");
        let finished = started.finish();
        let ended = finished.ended();
        let topic = &ended.topics[0];
        let stale =
            decisions(out.path()).iter().filter(|decision| !decision.triggers.is_empty()).count()
                as u64;
        // Two may arrive between selection and check if the machine stalls in between.
        assert!(
            10 * stale <= ended.wakes + 10,
            "{stale} of {} wakes were not for the newest frame",
            ended.wakes
        );
        assert_eq!(ended.faults, 0, "{}", finished.stderr);
        assert_eq!(ended.wakes + topic.skipped, topic.received, "{topic:?}");
        if behaviour == "sleep" {
            assert!(topic.skipped > 0 && topic.no_slot == 0, "{topic:?}");
        } else {
            assert!(topic.no_slot > 0, "{topic:?}");
            let warning =
                finished.stderr.lines().find(|line| line.contains("the lambda holds all slots"));
            assert!(warning.is_some_and(|line| line.contains(&topic.topic)), "{}", finished.stderr);
        }
        // Each sent sample is counted once.
        let counted = topic.received + topic.no_slot + topic.too_big + topic.lost.unwrap_or(0);
        assert!(counted <= FRAMES, "{topic:?}");
        counted == FRAMES
    };
    let are_whole: Vec<_> = runs.into_iter().zip(&outs).map(compared).collect();
    are_whole.into_iter().all(|is_whole| is_whole)
}

fn ctrl_c() {
    let out = TempFolder::new();
    let set = ["--set", "brake_mps2=-1.4"];
    let lambda = with_long_deadline("examples/brake-dark/rust");
    let started = run(lambda.path(), out.path(), &set);
    started.until_ready();
    let drive = sample_drive();
    let path = drive.to_str().expect("the checkout has a plain path");
    // The night brake is at 10.8 s.
    let player = play(&[path, "--wait", "1", "--start", "8"]);
    started.until("a window", |line| match line {
        JsonReport::Recorder(RecorderReport::Status(status)) if status.is_recording => Some(()),
        _ => None,
    });
    started.signal("INT");
    let finished = started.finish();
    drop(player);
    assert!(finished.status.success(), "{}", finished.stderr);
    let clips = clips(out.path());
    assert_eq!(clips.len(), 1);
    assert!(
        clips[0].incomplete.iter().any(|why| why.contains("stopped")),
        "{:?}",
        clips[0].incomplete
    );
    assert!(clips[0].topics.iter().all(|topic| topic.messages > 0), "{:?}", clips[0].topics);
    assert!(out.path().join("summary.json").is_file());
}

fn killed(name: &str) {
    let out = TempFolder::new();
    let set = ["--set", "brake_mps2=-1.4"];
    let lambda = with_long_deadline("examples/brake-dark/python");
    let started = run(lambda.path(), out.path(), &set);
    started.until_ready();
    let drive = sample_drive();
    let path = drive.to_str().expect("the checkout has a plain path");
    let player = play(&[path, "--wait", "1", "--start", "8"]);
    let (mut reported, mut is_recording) = (Vec::new(), false);
    started.until("a window", |line| {
        match line {
            JsonReport::Lambda(Report::Decision(decision)) => {
                reported.extend(trigger_keys(std::slice::from_ref(&decision)))
            }
            JsonReport::Recorder(RecorderReport::Status(status)) => {
                is_recording = status.is_recording
            }
            _ => {}
        }
        (is_recording && !reported.is_empty()).then_some(())
    });
    // Without a complete chunk there is nothing to recover.
    wait_for("some of the clip on disk", || {
        let files = std::fs::read_dir(out.path().join("clips")).into_iter().flatten().flatten();
        files.filter_map(|file| file.metadata().ok()).any(|file| file.len() > 64 << 10)
    });
    let victims = descendants(started.pid(), name);
    assert_eq!(victims.len(), 1, "{victims:?}");
    signal(victims[0], "KILL");
    started.until_ready();
    started.until_live("samples after the restart", |live| {
        live.restarts == 1 && live.topics[0].received > 0
    });
    started.signal("INT");
    let finished = started.finish();
    drop(player);
    assert!(finished.stderr.contains("restarting in 1 s (restart 1)"), "{}", finished.stderr);
    // Reported decisions are in the file.
    assert!(
        !reported.is_empty() && trigger_keys(&decisions(out.path())).starts_with(&reported),
        "{reported:?}"
    );
    let clips = clips(out.path());
    // If only the lambda's process dies, the clip is complete.
    assert_eq!(clips.len(), 1, "{clips:?}");
    assert_eq!(clips[0].recovered.is_some(), name == "gleaner-recorder", "{clips:?}");
    assert!(clips[0].topics.iter().any(|topic| topic.messages > 0), "{clips:?}");
}

fn ends_with(parent: Option<&str>) {
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

fn every_wake() {
    for language in ["rust", "python"] {
        let lambda = LambdaCopy::of(&format!("tests/lambdas/attack/{language}"), |manifest| {
            manifest.replace("\"20ms\"", "\"1ms\"")
        });
        let out = TempFolder::new();
        let started = run(lambda.path(), out.path(), &["--no-record", "--all"]);
        started.until_live("some thousand wakes", |live| live.wakes >= 3000);
        started.signal("INT");
        let finished = started.finish();
        let (ended, written) = (finished.ended(), decisions(out.path()));
        assert_eq!(
            (written.len() as u64, ended.unwritten),
            (ended.wakes, 0),
            "{}",
            finished.stderr
        );
        assert!(written.is_sorted_by(|a, b| a.at_ns < b.at_ns));
        let summary: LiveStatus =
            serde_json::from_slice(&std::fs::read(out.path().join("summary.json")).unwrap())
                .unwrap();
        assert_eq!((summary.wakes, summary.unwritten), (ended.wakes, 0));
    }
}

fn killed_at_once() {
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
    started.signal("INT");
    let finished = started.finish();
    assert!(finished.stderr.contains("was ended by signal 9"), "{}", finished.stderr);
    // The killed process could not count its last wake.
    let summary: LiveStatus =
        serde_json::from_slice(&std::fs::read(out.path().join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary.faults, finished.ended().faults + 1);
}

fn stopped() {
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
    let stopped =
        descendants(reading.pid(), "gleaner-runtime").into_iter().next_back().expect("its runtime");
    // The shim first, because it would react.
    let shim = descendants(reading.pid(), "gleaner-shim")[0];
    [shim, stopped].into_iter().for_each(|pid| signal(pid, "STOP"));
    let from = writing.until_live("unsent decisions", |live| live.unsent > 0);
    let to = writing.until_live("another second", |live| live.up_s > from.up_s + 1.0);
    [stopped, shim].into_iter().for_each(|pid| signal(pid, "CONT"));
    // 1,000 a second are due; if the lambda waited for the reader, it would be 10.
    let rate = (to.wakes - from.wakes) as f64 / (to.up_s - from.up_s);
    assert!(
        rate > 50.0 && to.unsent > from.unsent,
        "{rate} wakes per second, {} not sent",
        to.unsent
    );
    writing.signal("INT");
    assert!(writing.finish().ended().unsent >= to.unsent);
    reading.signal("INT");
    reading.finish();
}

fn no_writer() {
    let out = TempFolder::new();
    let started = run(&lambda("examples/hello", "rust"), out.path(), &["--for", "5"]);
    let finished = started.finish();
    assert!(finished.status.success(), "{}", finished.stderr);
    assert!(
        finished.stderr.contains("no writer of `/imu/data` (sensor_msgs/msg/Imu) yet"),
        "{}",
        finished.stderr
    );
    assert_eq!(finished.ended().topics[0].received, 0);
}

fn clips(out: &Path) -> Vec<Clip> {
    let text = std::fs::read_to_string(out.join("clips.jsonl")).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).expect("a line is a clip")).collect()
}

fn wait_for(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + live::PATIENCE;
    while !is_so() {
        assert!(Instant::now() < deadline, "waited for {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
