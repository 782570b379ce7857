//! Runs the examples and test lambdas over recorded drives: decisions as expected, and twins that
//! agree.
//!
//! Drives that cannot be part of the project are in the folder that `GLEANER_SHARED` names; tests
//! without their drive are ignored with that reason.

use std::path::Path;

use gleaner_lambda::twins_differ;
use gleaner_tests::{ReplayRun, replay, root, sample_drive, shared_file};
use libtest_mimic::{Failed, Trial};

use crate::clips::{needing, same};

const KINDS: [&str; 2] = ["rust", "python"];

/// The examples, with settings that suit the gentle braking of the sample drive.
const EXAMPLES: [(&str, &[&str]); 4] = [
    ("hello", &["--set", "brake_mps2=-1.4"]),
    ("brake-dark", &["--set", "brake_mps2=-1.4"]),
    ("imu-fft", &[]),
    ("yolo-detector", &["--set", "classes=car, truck", "--to", "3"]),
];

pub fn trials() -> Vec<Trial> {
    let mut trials = Vec::new();
    for (example, set) in EXAMPLES {
        for kind in KINDS {
            trials
                .push(Trial::test(format!("{example}_in_{kind}_decides_as_expected"), move || {
                    expected(example, kind, set)
                }));
        }
        trials.push(Trial::test(
            format!("the_twins_of_{example}_agree_on_every_wake"),
            move || {
                twins(&format!("examples/{example}"), &sample_drive(), &[&["--all"], set].concat())
            },
        ));
    }
    trials.push(Trial::test("every_function_returns_the_same_to_both_twins", all_results));
    for kind in KINDS {
        trials.push(needing(
            &format!("brake_dark_in_{kind}_finds_both_brakings_at_night"),
            shared_file("rec_brake_dark.mcap"),
            move |drive| at(&drive, "examples/brake-dark", kind, &[15.84, 30.25]),
        ));
        trials.push(needing(
            &format!("hello_in_{kind}_finds_six_of_six_brakings"),
            shared_file("rec_brake_imu_trip17.mcap"),
            move |drive| within_truth(&drive, kind),
        ));
        trials.push(needing(
            &format!("pixels_in_{kind}_sees_the_recorded_pixels"),
            shared_file("rec_raw_image_bgr8_320x180.mcap"),
            move |drive| pixels(&drive, kind),
        ));
    }
    trials.push(needing(
        "yolo_detector_finds_people_and_its_twins_agree",
        shared_file("rec_objects_5hz.mcap"),
        |drive| people(&drive),
    ));
    trials.push(needing(
        "the_twins_of_imu_fft_agree_on_a_walk",
        shared_file("rec_sync_gopro_walk.mcap"),
        |drive| {
            twins(
                "examples/imu-fft",
                &drive,
                &["--all", "--set", "window_s=5.2", "--set", "rough=0"],
            )
        },
    ));
    trials.push(needing(
        "the_twins_of_pixels_agree",
        shared_file("rec_raw_image_bgr8_320x180.mcap"),
        |drive| twins("tests/lambdas/pixels", &drive, &["--all"]),
    ));
    trials
}

fn run(lambda: &str, kind: &str, drive: &Path, args: &[&str]) -> Result<ReplayRun, Failed> {
    let run = replay(&root().join(lambda).join(kind), &[drive.to_owned()], args);
    if run.exit == 0 { Ok(run) } else { Err(format!("exit {}: {}", run.exit, run.stderr).into()) }
}

fn expected(example: &str, kind: &str, set: &[&str]) -> Result<(), Failed> {
    let run = run(&format!("examples/{example}"), kind, &sample_drive(), set)?;
    let expected =
        std::fs::read_to_string(root().join("examples").join(example).join("expected.txt"))?;
    same(&run.rows(), &expected)
}

/// People are found in 16 of the 20 frames that show some, and in at most 1 of the 24 others.
fn people(drive: &Path) -> Result<(), Failed> {
    let truth = std::fs::read_to_string(drive.with_extension("truth.json"))?;
    let truth: serde_json::Value = serde_json::from_str(&truth)?;
    let frames = truth["frames"].as_array().ok_or("no frames")?;
    let shows = |wanted: bool| {
        let frames = frames.iter().filter(move |frame| frame["has_person"] == wanted);
        frames.filter_map(|frame| frame["stamp_ns"].as_i64()).collect::<Vec<_>>()
    };
    let found = run("examples/yolo-detector", "rust", drive, &["--all"])?;
    let has_person = |at_ns: &i64| {
        let mut decisions = found.decisions.iter().filter(|decision| decision.at_ns == *at_ns);
        decisions.any(|it| it.triggers.iter().any(|trigger| trigger.label == "person"))
    };
    let found = [shows(true), shows(false)]
        .map(|frames| (frames.iter().filter(|at_ns| has_person(at_ns)).count(), frames.len()));
    let [(hits, with), (mistakes, without)] = found;
    if (with, without) != (20, 24) || hits < 16 || mistakes > 1 {
        return Err(format!("{hits} of {with} people, {mistakes} of {without} others").into());
    }
    twins("examples/yolo-detector", drive, &["--all"])
}

fn twins(lambda: &str, drive: &Path, args: &[&str]) -> Result<(), Failed> {
    let (rust, python) = (run(lambda, "rust", drive, args)?, run(lambda, "python", drive, args)?);
    same(&rust.decisions.len(), &python.decisions.len())?;
    if rust.decisions.is_empty() {
        return Err("no wakes".into());
    }
    match rust.decisions.iter().zip(&python.decisions).find_map(|(a, b)| twins_differ(a, b)) {
        Some(difference) => Err(difference.into()),
        None => Ok(()),
    }
}

/// Compares all results that `probe` reports, attribute by attribute, to the last digit.
fn all_results() -> Result<(), Failed> {
    let [rust, python] = KINDS.map(|kind| run("tests/lambdas/probe", kind, &sample_drive(), &[]));
    let (rust, python) = (rust?, python?);
    same(&rust.decisions.len(), &10)?;
    for (a, b) in rust.decisions.iter().zip(&python.decisions) {
        same(&a.triggers.iter().map(|trigger| trigger.label.as_str()).collect(), &PROBED.to_vec())?;
        same(&a.triggers, &b.triggers)?;
    }
    let kept =
        |run: &ReplayRun| run.log.iter().map(|line| line["message"].clone()).collect::<Vec<_>>();
    same(&kept(&rust), &kept(&python))?;
    same(&rust.log.len(), &10)?;
    // The first image was taken by day; and each refusal is the expected one.
    let first = &rust.decisions[0].triggers;
    same(&first[2].score.is_some_and(|luma| (75.0..132.0).contains(&luma)), &true)?;
    same(&first[3].attributes["pixels"].as_i64().is_some_and(|hash| hash >= 0), &true)?;
    let refusals = first[4].attributes.values().map(|kind| kind.as_str().unwrap_or_default());
    same(&refusals.collect::<Vec<_>>(), &REFUSALS.to_vec())
}

/// Labels that `probe` triggers in each wake, and the refusals that it provokes, in its order.
const PROBED: [&str; 7] =
    ["topic", "sample", "frame", "tensor", "refusals", "recording", "recording"];
const REFUSALS: [&str; 14] = [
    "no-such-input",
    "no-such-field",
    "wrong-field",
    "wrong-field",
    "not-a-frame",
    "out-of-range",
    "out-of-range",
    "no-room",
    "invalid",
    "invalid",
    "no-such-model",
    "wrong-input",
    "wrong-input",
    "wrong-input",
];

fn at(drive: &Path, lambda: &str, kind: &str, onsets: &[f64]) -> Result<(), Failed> {
    let run = run(lambda, kind, drive, &["--set", "brake_mps2=-3.0"])?;
    let seconds = run.seconds();
    let near = |(found, onset): (&f64, &f64)| (onset - 0.3..=onset + 1.5).contains(found);
    if seconds.len() == onsets.len() && seconds.iter().zip(onsets).all(near) {
        return Ok(());
    }
    Err(format!("triggers at {seconds:?}, expected near {onsets:?}").into())
}

/// Exactly one trigger in each labelled hard braking, and no other.
fn within_truth(drive: &Path, kind: &str) -> Result<(), Failed> {
    let truth = truth(drive)?;
    let events = truth["labelled_events"].as_array().ok_or("the truth has no labelled events")?;
    let second = |event: &serde_json::Value, key: &str| event[key].as_f64().unwrap_or(f64::NAN);
    let brakings = events.iter().filter(|event| event["type"] == "hard_brake");
    let spans = brakings
        .map(|event| (second(event, "start_s"), second(event, "end_s")))
        .collect::<Vec<_>>();
    let seconds = run("examples/hello", kind, drive, &["--set", "brake_mps2=-3.0"])?.seconds();
    let inside =
        |(found, (start, end)): (&f64, &(f64, f64))| (start - 0.3..=end + 1.5).contains(found);
    if spans.len() == 6 && seconds.len() == 6 && seconds.iter().zip(&spans).all(inside) {
        return Ok(());
    }
    Err(format!("triggers at {seconds:?}, labelled {spans:?}").into())
}

fn pixels(drive: &Path, kind: &str) -> Result<(), Failed> {
    let truth = truth(drive)?;
    let hashes = truth["fnv1a32_of_pixels"].as_array().ok_or("the truth has no hashes")?;
    let hashes =
        hashes.iter().map(|hash| format!("{:08x}", hash.as_u64().unwrap_or(0))).collect::<Vec<_>>();
    let found = run("tests/lambdas/pixels", kind, drive, &[])?;
    same(&found.decisions.len(), &21)?;
    same(&found.labels(), &hashes)
}

fn truth(drive: &Path) -> Result<serde_json::Value, Failed> {
    Ok(serde_json::from_str(&std::fs::read_to_string(drive.with_extension("truth.json"))?)?)
}
