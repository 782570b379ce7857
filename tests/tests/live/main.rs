//! Lambdas on live topics: `gleaner run` with the recorder and the player, each case in a private
//! network.

mod alone;
mod as_in_replay;
mod chaos;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use gleaner_lambda::{Clip, Decision, Fault};
use gleaner_protocol::Report;
use gleaner_protocol::link::RecorderReport;
use gleaner_tests::live::{
    self, JsonReport, RunningProgram, decisions, descendants, no_player, play, run, run_all, signal,
};
use gleaner_tests::{LambdaCopy, TempFolder, namespace, root, sample_drive};
use libtest_mimic::{Arguments, Trial};

/// Environment variable with the case that this process runs in its private network.
const CASE: &str = "GLEANER_LIVE_CASE";

type LiveCase = (&'static str, fn());

const PLAYED: &[LiveCase] = &[
    ("a_drive_played_live_is_decided_as_in_its_replay", as_in_replay::as_in_replay),
    ("a_lambda_slower_than_its_camera_gets_the_newest_frame_and_skips_are_counted", || {
        slow("sleep")
    }),
    (
        "a_lambda_that_keeps_every_frame_does_not_stop_the_reception_and_refusals_are_counted",
        || slow("keep"),
    ),
    ("ctrl_c_stops_the_run_and_closes_open_clips", ctrl_c),
    ("several_lambdas_and_the_recorder_share_what_one_process_receives", shared),
    ("a_lambda_whose_process_is_killed_is_started_again_and_loses_no_decision", || {
        killed("start.py")
    }),
    ("a_recorder_that_is_killed_is_started_again_and_its_clip_recovered", || {
        killed("gleaner-recorder")
    }),
    ("lambdas_and_recorder_run_on_when_the_ingress_is_killed_and_receive_again", ingress_killed),
    (
        "whatever_is_killed_each_sample_is_counted_and_listed_clips_are_whole",
        chaos::killed_at_random,
    ),
];

/// Cases with lambdas only.
const ALONE: &[LiveCase] = &[
    ("a_topic_without_a_writer_is_reported", alone::no_writer),
    ("a_stopped_reader_of_decisions_does_not_block_the_lambda", alone::stopped),
    ("a_lambda_does_not_outlive_the_command_that_started_it", || alone::ends_with(None)),
    ("a_lambda_does_not_outlive_its_shim", || alone::ends_with(Some("gleaner-shim"))),
    ("every_wake_at_1_khz_is_written_with_all", alone::every_wake),
    ("reported_decisions_are_in_the_file_even_if_the_process_is_killed", alone::killed_at_once),
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

/// Number of frames that the player sends: 6 s.
const FRAMES: u64 = 180;

fn slow(behaviour: &str) {
    // A busy machine may lose frames before the first one that arrives, which are not counted; then
    // they are played again.
    let is_whole = (0..6).any(|_| slow_round(behaviour));
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
        let finished = started.interrupt();
        let ended = finished.ended();
        let topic = &ended.topics[0];
        let stale =
            decisions(out.path()).iter().filter(|decision| !decision.triggers.is_empty()).count()
                as u64;
        // Two may arrive between selection and check if the machine stalls in between.
        let wakes = ended.wakes;
        assert!(10 * stale <= wakes + 10, "{stale} of {wakes} wakes were not for the newest frame");
        if behaviour == "sleep" {
            assert_eq!(ended.faults, 0, "{}", finished.stderr);
            assert_eq!(ended.wakes + topic.skipped, topic.received, "{topic:?}");
            assert!(topic.skipped > 0 && topic.no_slot == 0, "{topic:?}");
        } else {
            let faults: Vec<_> =
                decisions(out.path()).into_iter().filter_map(|it| it.fault).collect();
            assert_eq!(faults.len() as u64, ended.faults);
            let names_hold = |fault: &Fault| fault.message.contains("`hold`");
            assert!(!faults.is_empty() && faults.iter().all(names_hold), "{faults:?} {ended:?}");
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
    let finished = started.interrupt();
    drop(player);
    assert!(finished.status.success(), "{}", finished.stderr);
    let clips = clips(out.path());
    assert_eq!(clips.len(), 1);
    let incomplete = &clips[0].incomplete;
    assert!(incomplete.iter().any(|why| why.contains("stopped")), "{incomplete:?}");
    assert!(clips[0].topics.iter().all(|topic| topic.messages > 0), "{:?}", clips[0].topics);
    assert!(out.path().join("summary.json").is_file());
}

/// Runs the lambdas `first` and `second`, and waits until both are ready. Also returns their
/// folders.
fn run_two(out: &Path) -> (RunningProgram, [LambdaCopy; 2]) {
    let lambdas = [("examples/hello/rust", "first"), ("examples/hello/python", "second")]
        .map(|(of, name)| LambdaCopy::named(of, name));
    let folders = [lambdas[0].path(), lambdas[1].path()];
    let started = run_all(&folders, out, &["--set", "first.brake_mps2=-1.4"]);
    started.until_all_ready(2);
    (started, lambdas)
}

fn shared() {
    let out = TempFolder::new();
    let (started, _lambdas) = run_two(out.path());
    let drive = sample_drive();
    let path = drive.to_str().expect("the checkout has a plain path");
    let played = play(&[path, "--wait", "1", "--start", "8", "--duration", "5"]).finish();
    assert!(played.status.success(), "{}", played.stderr);
    let ingresses = descendants(started.pid(), "gleaner-ingress");
    assert_eq!(ingresses.len(), 1, "{ingresses:?}");
    let (mut received, mut writers) = ([0; 2], [None; 2]);
    started.until_named("the end of the drive", |name, report| {
        if let Report::Live(live) = report {
            let index = usize::from(name == "second");
            (received[index], writers[index]) = (live.topics[0].received, live.topics[0].writers);
        }
        let is_over = received[0] == received[1] && received[0] > 0 && writers == [Some(0); 2];
        is_over.then_some(())
    });
    let finished = started.interrupt();
    assert!(finished.status.success(), "{}: {}", finished.status, finished.stderr);
    let imu = [0, 1].map(|index| {
        let name = ["first", "second"][index];
        finished.ended_of(name).expect("it ended").topics[0].received
    });
    assert_eq!(imu, received, "{}", finished.stderr);
    let recorder = live::summary(&out.path().join("second")).recording.expect("a recorder");
    let recorded = recorder.topics.iter().find(|topic| topic.topic == "/imu/data");
    assert_eq!(recorded.expect("it is recorded").received, imu[0], "{recorder:?}");
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
    let restart = if name == "gleaner-recorder" {
        started.until("the recovered clip", |line| match line {
            JsonReport::Recorder(RecorderReport::Recovered(_)) => Some(()),
            _ => None,
        });
        started.until_live("the lambda beside the next recorder", |live| {
            live.restarts == 0 && live.recorder_link.is_some_and(|it| it.recorders_ended == 1)
        });
        "restarting in 0.1 s (restart 1)"
    } else {
        started.until_ready();
        started.until_live("samples after the restart", |live| {
            live.restarts == 1 && live.topics[0].received > 0
        });
        "restarting in 1 s (restart 1)"
    };
    let finished = started.interrupt();
    drop(player);
    assert!(finished.stderr.contains(restart), "{}", finished.stderr);
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

fn ingress_killed() {
    let out = TempFolder::new();
    let (started, _lambdas) = run_two(out.path());
    let drive = sample_drive();
    let path = drive.to_str().expect("the checkout has a plain path");
    // The night brake is at 10.8 s.
    let player = play(&[path, "--wait", "1", "--start", "8"]);
    started.until("a window", |line| match line {
        JsonReport::Recorder(RecorderReport::Status(status)) if status.is_recording => Some(()),
        _ => None,
    });
    let readers = || {
        let names = ["gleaner-runtime", "start.py", "gleaner-recorder"];
        names.map(|name| descendants(started.pid(), name))
    };
    let before = readers();
    let ingress = descendants(started.pid(), "gleaner-ingress");
    assert!(before.iter().all(|pids| !pids.is_empty()) && ingress.len() == 1, "{before:?}");
    signal(ingress[0], "KILL");
    let mut received = [None; 2];
    started.until_named("samples from the next ingress", |name, report| {
        if let Report::Live(live) = report
            && live.reception_gaps.count == 1
            && live.topics[0].writers == Some(1)
        {
            let first = received[usize::from(name == "second")].get_or_insert(live.wakes);
            return (live.wakes > *first && !received.contains(&None)).then_some(());
        }
        None
    });
    assert_eq!(readers(), before, "they run on");
    drop(player);
    let finished = started.interrupt();
    let reason =
        "the ingress ended unexpectedly (signal: 9 (SIGKILL)); restarting in 0.1 s (restart 1)";
    assert!(finished.stderr.contains(reason), "{}", finished.stderr);
    assert_eq!(finished.status.code(), Some(1), "a process has failed: {}", finished.stderr);
    for name in ["first", "second"] {
        let ended = finished.ended_of(name).expect("it ended");
        assert_eq!((ended.restarts, ended.faults, ended.reception_gaps.count), (0, 0, 1));
        assert!(ended.reception_gaps.ms > 0, "{ended:?}");
    }
    let summary = live::summary(&out.path().join("first"));
    assert_eq!(summary.recording.expect("a recorder").reception_gaps.count, 1);
    let clips = clips(out.path());
    assert!(!clips.is_empty());
    let says =
        |clip: &Clip| clip.incomplete.iter().any(|why| why.contains("the ingress had ended"));
    assert!(clips.iter().any(says), "{clips:?}");
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
