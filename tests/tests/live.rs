//! Lambdas on live topics: `gleaner run`, with the recorder and the player, each in a private
//! network.
//!
//! `GLEANER_ROUNDS` says how often a drive is played and compared with its replay; once if it does
//! not.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use gleaner_lambda::{Clip, Decision, FaultKind};
use gleaner_protocol::link::RecorderReport;
use gleaner_protocol::{Live, Report};
use gleaner_tests::live::{self, Line, Started, below, decisions, no_player, play, run, signal};
use gleaner_tests::{Copy, Folder, namespace, replay_to, root, sample_drive, times};
use libtest_mimic::{Arguments, Trial};

/// Names the case that this process is to run in the network that it was started in.
const CASE: &str = "GLEANER_LIVE_CASE";

type Case = (&'static str, fn());

/// Cases with a player.
const PLAYED: &[Case] = &[
    ("a_drive_played_live_is_decided_as_in_its_replay", as_in_replay),
    ("a_lambda_slower_than_its_camera_sees_the_newest_frame_and_skips_are_counted", || {
        slow("sleep")
    }),
    (
        "a_lambda_that_keeps_every_frame_does_not_stop_the_reception_and_refusals_are_counted",
        || slow("keep"),
    ),
    ("ctrl_c_ends_in_order_and_clips_that_are_open_are_closed", ctrl_c),
    ("a_lambda_whose_process_is_killed_is_started_again_and_loses_no_decision", || {
        killed("start.py")
    }),
    ("a_recorder_that_is_killed_is_started_again_and_its_clip_recovered", || {
        killed("gleaner-recorder")
    }),
];

/// Cases with nothing but lambdas.
const ALONE: &[Case] = &[
    ("a_topic_that_nobody_writes_is_said", nobody_writes),
    ("a_reader_that_has_stopped_does_not_hold_up_the_lambda_that_it_listens_to", stopped),
    ("a_lambda_does_not_outlive_the_command_that_started_it", || outlives(None)),
    ("a_lambda_does_not_outlive_its_shim", || outlives(Some("gleaner-shim"))),
    ("every_wake_at_1_khz_is_written_if_all_are_asked_for", every_wake),
    ("what_was_reported_is_in_the_file_though_the_process_is_killed_at_once", killed_at_once),
];

fn main() -> ExitCode {
    if let Ok(name) = std::env::var(CASE) {
        let (_, case) = PLAYED
            .iter()
            .chain(ALONE)
            .find(|(known, _)| *known == name)
            .expect("a case of this suite");
        case();
        return ExitCode::SUCCESS;
    }
    let trial = |(name, _): &Case, missing: Option<&str>| {
        let name = *name;
        let run = move || namespace::case(CASE, name);
        match missing {
            Some(why) => Trial::test(format!("{name} [{why}]"), run).with_ignored_flag(true),
            None => Trial::test(name, run),
        }
    };
    let mut arguments = Arguments::from_args();
    // They measure nothing, but starving each other would make samples skip.
    arguments.test_threads = Some(1);
    let (no_network, no_player) = (namespace::unavailable(), no_player());
    let played = PLAYED.iter().map(|case| trial(case, no_network.or(no_player)));
    let trials = played.chain(ALONE.iter().map(|case| trial(case, no_network))).collect();
    libtest_mimic::run(&arguments, trials).exit_code()
}

fn lambda(name: &str, language: &str) -> PathBuf {
    root().join(name).join(language)
}

/// A copy of a lambda with more time than it needs. A fault would take what it has learned, and
/// nothing here is about time.
fn patient(lambda: &str) -> Copy {
    let line = |line: &str| {
        if line.starts_with("deadline") { "deadline = \"5s\"" } else { line }.to_owned()
    };
    Copy::of(lambda, |manifest| manifest.lines().map(line).collect::<Vec<_>>().join("\n"))
}

/// What a decision is about: the label, and which of the camera's or IMU's samples.
type About = (String, Option<u64>);

/// What decisions are about.
fn about(decisions: &[Decision]) -> Vec<About> {
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

/// The same labels for the same samples of the camera, and for nearly the same of the IMU.
///
/// Both lambdas look at half a second of the IMU by receive stamps. Live, these jitter by a
/// millisecond and more, so that a sample at the edge is in or out; a threshold may then be passed
/// some samples earlier or later. A frame of the camera is 10 of them. Where samples were passed
/// over, it is by as many later.
fn alike(live: &[About], replay: &[About], skipped: u64) -> bool {
    let is_camera = replay.iter().all(|(label, _)| label == "brake-dark");
    let slack = skipped + if is_camera { 0 } else { 10 };
    let same = |((a, n), (b, m)): (&About, &About)| {
        a == b && n.zip(*m).is_some_and(|(n, m)| n.abs_diff(m) <= slack)
    };
    live.len() == replay.len() && live.iter().zip(replay).all(same)
}

fn lost(ended: &Live) -> u64 {
    ended
        .topics
        .iter()
        .map(|topic| topic.lost.expect("DDS tells") + topic.no_slot + topic.malformed)
        .sum()
}

/// A machine that is busy with others may stop for longer than a window jitters. What differs then
/// is played once more; what differs each time is wrong.
fn as_in_replay() {
    /// So often each lambda is played to, until it does as in its replay.
    const TRIES: usize = 6;
    let set = ["--set", "brake_mps2=-1.4"];
    let names = ["hello/rust", "hello/python", "brake-dark/rust", "brake-dark/python"];
    let lambdas = names.map(|name| patient(&format!("examples/{name}")));
    let drive = sample_drive();
    let replayed = |lambda: &Copy| {
        let out = Folder::new();
        let replayed = replay_to(out.path(), lambda.path(), std::slice::from_ref(&drive), &set);
        let expected = about(&replayed.decisions);
        assert!(!expected.is_empty(), "{}", replayed.stderr);
        (lambda.path().to_owned(), expected)
    };
    let expected: Vec<_> = lambdas.iter().map(replayed).collect();
    for round in 1..=times("GLEANER_ROUNDS", 1) {
        let mut left = names.to_vec();
        let mut differences = Vec::new();
        for _ in 0..TRIES {
            for (name, found) in names.into_iter().zip(played(&drive, &set, &expected)) {
                match found {
                    Some(difference) => differences.push(format!("{name}: {difference}")),
                    None => left.retain(|other| *other != name),
                }
            }
            if left.is_empty() {
                break;
            }
        }
        println!("round {round}: {} differences {differences:#?}", differences.len());
        assert!(
            left.is_empty(),
            "round {round}: {TRIES} times another than in the replay: {differences:#?}"
        );
    }
}

/// Plays the drive to these lambdas at once; in which way each did something else than in its
/// replay, if it did.
fn played(drive: &Path, set: &[&str; 2], lambdas: &[(PathBuf, Vec<About>)]) -> Vec<Option<String>> {
    let args = [set[0], set[1], "--no-record"];
    let outs: Vec<Folder> = lambdas.iter().map(|_| Folder::new()).collect();
    let runs: Vec<Started> = lambdas
        .iter()
        .zip(&outs)
        .map(|((lambda, _), out)| run(lambda, out.path(), &args))
        .collect();
    runs.iter().for_each(Started::until_ready);
    let path = drive.to_str().expect("the checkout has a plain path");
    let played =
        play(&[path, "--wait", "2", "--topics", "/imu/data,/camera/front/compressed"]).finish();
    assert!(played.status.success(), "{}", played.said);
    // The last sample may still be on its way, and windows are open for some seconds after it.
    for started in &runs {
        started.until_live("the end of the drive", |live| {
            let is_over =
                live.topics.iter().all(|topic| topic.writers == Some(0) && topic.received > 0);
            // Each event sample has been considered: one of the topics causes the wakes.
            is_over && live.topics.iter().any(|topic| live.wakes + topic.skipped == topic.received)
        });
        started.signal("INT");
    }
    let compared =
        |((started, out), (_, expected)): ((Started, &Folder), &(PathBuf, Vec<About>))| {
            let finished = started.finish();
            assert!(finished.status.success(), "{}, {}", finished.status, finished.said);
            let ended = finished.ended();
            assert_eq!(ended.faults, 0, "{}", finished.said);
            let live = about(&decisions(out.path()));
            if lost(&ended) == 0 && alike(&live, expected, ended.skipped) {
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

/// Frames that the player sends: 6 s of them.
const FRAMES: u64 = 180;

fn slow(behaviour: &str) {
    // What a busy machine kept from the first frame on, nobody counts: then they are played once
    // more.
    let is_whole = (0..3).any(|_| slowly(behaviour));
    assert!(is_whole, "frames were lost before the first that arrived, each time");
}

/// Plays frames to lambdas that are slower, or keep them. Whether all frames are accounted for.
fn slowly(behaviour: &str) -> bool {
    let outs = [Folder::new(), Folder::new()];
    let set = format!("behaviour={behaviour}");
    let start = |(language, out): (&str, &Folder)| {
        run(&lambda("tests/lambdas/slow", language), out.path(), &["--all", "--set", &set])
    };
    let runs: Vec<Started> = ["rust", "python"].into_iter().zip(&outs).map(start).collect();
    runs.iter().for_each(Started::until_ready);
    let player = play(&["--synthetic", "640x480@30", "--wait", "2", "--duration", "6"]).finish();
    assert!(player.status.success(), "{}", player.said);
    let compared = |(started, out): (Started, &Folder)| {
        let mut before = None;
        // Frames may still be on their way when the player has gone.
        started.until_live("the end of the pictures", |live| {
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
        // Two may arrive between being chosen and being looked at, on a machine that stops in
        // between.
        assert!(
            10 * stale <= ended.wakes + 10,
            "{stale} of {} wakes were not for the newest frame",
            ended.wakes
        );
        assert_eq!(ended.faults, 0, "{}", finished.said);
        assert_eq!(ended.wakes + topic.skipped, topic.received, "{topic:?}");
        if behaviour == "sleep" {
            assert!(topic.skipped > 0 && topic.no_slot == 0, "{topic:?}");
        } else {
            assert!(topic.no_slot > 0, "{topic:?}");
            let warning =
                finished.said.lines().find(|line| line.contains("the lambda holds all slots"));
            assert!(warning.is_some_and(|line| line.contains(&topic.topic)), "{}", finished.said);
        }
        // Each sample that was sent is accounted for, once.
        let told = topic.received + topic.no_slot + topic.too_big + topic.lost.unwrap_or(0);
        assert!(told <= FRAMES, "{topic:?}");
        told == FRAMES
    };
    let are_whole: Vec<_> = runs.into_iter().zip(&outs).map(compared).collect();
    are_whole.into_iter().all(|is_whole| is_whole)
}

fn ctrl_c() {
    let out = Folder::new();
    let set = ["--set", "brake_mps2=-1.4"];
    let lambda = patient("examples/brake-dark/rust");
    let started = run(lambda.path(), out.path(), &set);
    started.until_ready();
    let drive = sample_drive();
    let path = drive.to_str().expect("the checkout has a plain path");
    // The night brake is at 10.8 s.
    let player = play(&[path, "--wait", "1", "--start", "8"]);
    started.until("a window", |line| match line {
        Line::Recorder(RecorderReport::Status(status)) if status.is_recording => Some(()),
        _ => None,
    });
    started.signal("INT");
    let finished = started.finish();
    drop(player);
    assert!(finished.status.success(), "{}", finished.said);
    let clips = clips(out.path());
    assert_eq!(clips.len(), 1);
    assert!(clips[0].short.iter().any(|why| why.contains("stopped")), "{:?}", clips[0].short);
    assert!(clips[0].topics.iter().all(|topic| topic.messages > 0), "{:?}", clips[0].topics);
    assert!(out.path().join("summary.json").is_file());
}

fn killed(name: &str) {
    let out = Folder::new();
    let set = ["--set", "brake_mps2=-1.4"];
    let lambda = patient("examples/brake-dark/python");
    let started = run(lambda.path(), out.path(), &set);
    started.until_ready();
    let drive = sample_drive();
    let path = drive.to_str().expect("the checkout has a plain path");
    let player = play(&[path, "--wait", "1", "--start", "8"]);
    let (mut told, mut is_recording) = (Vec::new(), false);
    started.until("a window", |line| {
        match line {
            Line::Lambda(Report::Decision(decision)) => {
                told.extend(about(std::slice::from_ref(&decision)))
            }
            Line::Recorder(RecorderReport::Status(status)) => is_recording = status.is_recording,
            _ => {}
        }
        (is_recording && !told.is_empty()).then_some(())
    });
    // Before its first whole chunk, there is nothing to recover.
    wait_for("some of the clip on disk", || {
        let files = std::fs::read_dir(out.path().join("clips")).into_iter().flatten().flatten();
        files.filter_map(|file| file.metadata().ok()).any(|file| file.len() > 64 << 10)
    });
    let victims = below(started.pid(), name);
    assert_eq!(victims.len(), 1, "{victims:?}");
    signal(victims[0], "KILL");
    started.until_ready();
    started.until_live("samples after the restart", |live| {
        live.restarts == 1 && live.topics[0].received > 0
    });
    started.signal("INT");
    let finished = started.finish();
    drop(player);
    assert!(finished.said.contains("starting again in 1 s (restart 1)"), "{}", finished.said);
    // What was told before the death is in the file.
    assert!(!told.is_empty() && about(&decisions(out.path())).starts_with(&told), "{told:?}");
    let clips = clips(out.path());
    // The lambda's process may die while the recorder lives: then the clip has all that it should.
    assert_eq!(clips.len(), 1, "{clips:?}");
    assert_eq!(clips[0].recovered.is_some(), name == "gleaner-recorder", "{clips:?}");
    assert!(clips[0].topics.iter().any(|topic| topic.messages > 0), "{clips:?}");
}

fn outlives(who: Option<&str>) {
    let out = Folder::new();
    let started = run(&lambda("examples/hello", "python"), out.path(), &["--no-record"]);
    started.until_ready();
    let left = below(started.pid(), "start.py");
    assert_eq!(left.len(), 1);
    let starter = who.map_or(started.pid(), |name| below(started.pid(), name)[0]);
    signal(starter, "KILL");
    // A process that has ended has no command line, even where nobody asks how it ended.
    let line = format!("/proc/{}/cmdline", left[0]);
    wait_for("the end of the lambda's process", || {
        std::fs::read(&line).unwrap_or_default().is_empty()
    });
}

fn every_wake() {
    for language in ["rust", "python"] {
        let lambda = Copy::of(&format!("tests/lambdas/attack/{language}"), |manifest| {
            manifest.replace("\"20ms\"", "\"1ms\"")
        });
        let out = Folder::new();
        let started = run(lambda.path(), out.path(), &["--no-record", "--all"]);
        started.until_live("some thousand wakes", |live| live.wakes >= 3000);
        started.signal("INT");
        let finished = started.finish();
        let (ended, written) = (finished.ended(), decisions(out.path()));
        assert_eq!((written.len() as u64, ended.unwritten), (ended.wakes, 0), "{}", finished.said);
        assert!(written.is_sorted_by(|a, b| a.at_ns < b.at_ns));
        let summary: Live =
            serde_json::from_slice(&std::fs::read(out.path().join("summary.json")).unwrap())
                .unwrap();
        assert_eq!((summary.wakes, summary.unwritten), (ended.wakes, 0));
    }
}

fn killed_at_once() {
    let lambda = Copy::of("tests/lambdas/ticker/python", |manifest| {
        manifest.replace("\"100ms\"", "\"1ms\"")
    });
    let out = Folder::new();
    let started = run(lambda.path(), out.path(), &["--no-record"]);
    started.until_ready();
    let process = below(started.pid(), "start.py")[0];
    let mut told = Vec::new();
    started.until("the end of the process", |line| {
        let Line::Lambda(Report::Decision(decision)) = line else { return None };
        if told.is_empty() {
            signal(process, "KILL");
        }
        let is_killed =
            decision.fault.as_ref().is_some_and(|fault| fault.kind == FaultKind::Killed);
        told.push(*decision);
        is_killed.then_some(())
    });
    let written = decisions(out.path());
    assert!(
        told.len() > 1 && told.iter().all(|decision| written.contains(decision)),
        "{told:?}, written {written:?}"
    );
    started.until_live("the next process", |live| live.restarts == 1);
    started.signal("INT");
    let finished = started.finish();
    assert!(finished.said.contains("was ended by signal 9"), "{}", finished.said);
    // The process that broke could not count its last wake.
    let summary: Live =
        serde_json::from_slice(&std::fs::read(out.path().join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary.faults, finished.ended().faults + 1);
}

fn stopped() {
    const TOLD: &str = "/told";
    let talker =
        Copy::of("tests/lambdas/ticker/rust", |manifest| manifest.replace("\"100ms\"", "\"1ms\""));
    let listener = Copy::of("bench/lambdas/imu/rust", |manifest| {
        manifest
            .replace("/imu/synthetic", TOLD)
            .replace("sensor_msgs/msg/Imu", "std_msgs/msg/String")
    });
    let (told, heard) = (Folder::new(), Folder::new());
    let talks = run(talker.path(), told.path(), &["--no-record", "--decisions", TOLD]);
    let listens = run(listener.path(), heard.path(), &["--no-record"]);
    listens.until_live("decisions", |live| live.topics[0].received > 0);
    let stopped =
        below(listens.pid(), "gleaner-runtime").into_iter().next_back().expect("its runtime");
    // Its shim first, which would not stand by.
    let shim = below(listens.pid(), "gleaner-shim")[0];
    [shim, stopped].into_iter().for_each(|pid| signal(pid, "STOP"));
    let from = talks.until_live("what cannot be sent any more", |live| live.unsent > 0);
    let to = talks.until_live("a second more", |live| live.up_s > from.up_s + 1.0);
    [stopped, shim].into_iter().for_each(|pid| signal(pid, "CONT"));
    // 1,000 a second are due. Waiting for the reader, it would be 10.
    let rate = (to.wakes - from.wakes) as f64 / (to.up_s - from.up_s);
    assert!(
        rate > 50.0 && to.unsent > from.unsent,
        "{rate} wakes in a second, {} not sent",
        to.unsent
    );
    talks.signal("INT");
    assert!(talks.finish().ended().unsent >= to.unsent);
    listens.signal("INT");
    listens.finish();
}

fn nobody_writes() {
    let out = Folder::new();
    let started = run(&lambda("examples/hello", "rust"), out.path(), &["--for", "5"]);
    let finished = started.finish();
    assert!(finished.status.success(), "{}", finished.said);
    assert!(
        finished.said.contains("nobody writes `/imu/data` (sensor_msgs/msg/Imu) yet"),
        "{}",
        finished.said
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
