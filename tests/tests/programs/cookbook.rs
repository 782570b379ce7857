//! Tests of the cookbook's recipes, replayed by `gleaner`. On the sample drive, each must trigger
//! as its `expected.txt` documents. For events that the sample drive does not contain, a test
//! replays a changed copy.

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;

use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::LambdaKind;
use gleaner_tests::drive::{DriveMessage, changed};
use gleaner_tests::{ReplayRun, TempFolder, replay, root, sample_drive};

const IMU: &str = "/imu/data";
const SPEED: &str = "/vehicle/speed";
const CAMERA: &str = "/camera/front/compressed";

/// Index of `linear_acceleration.y` among the floats of an IMU message: after orientation, angular
/// velocity and their covariances.
const LATERAL: usize = 4 + 9 + 3 + 9 + 1;
/// Index of `twist.linear.x` among the floats of a speed message.
const FORWARD: usize = 0;

fn recipes() -> Vec<PathBuf> {
    let folders = fs::read_dir(root().join("examples/cookbook")).expect("the cookbook exists");
    let folders = folders.map(|folder| folder.expect("the folder can be listed").path());
    let mut recipes: Vec<_> =
        folders.filter(|folder| folder.join("lambda.toml").is_file()).collect();
    recipes.sort();
    recipes
}

/// Replays a recipe on the sample drive with each message changed by `change`, which returns
/// `false` to leave it out.
fn replay_changed(recipe: &str, change: impl FnMut(&mut DriveMessage) -> bool) -> ReplayRun {
    let folder = TempFolder::new();
    let drive = changed(&folder, change);
    let run = replay(&root().join("examples/cookbook").join(recipe), &[drive], &[]);
    run.must_exit(0);
    run
}

/// Returns the label and the time of each trigger; seconds are rounded down to tenths.
fn triggers(run: &ReplayRun) -> Vec<(String, f64)> {
    run.labels()
        .into_iter()
        .zip(run.seconds().into_iter().map(|second| (second * 10.0).floor() / 10.0))
        .collect()
}

/// Returns whether `message` is of `topic` and within these seconds of the drive.
fn is_within(message: &DriveMessage, topic: &str, from_s: f64, to_s: f64) -> bool {
    message.topic == topic && (from_s..to_s).contains(&message.at_s)
}

#[test]
fn there_are_ten_recipes_five_in_each_language() {
    let kinds = recipes()
        .iter()
        .map(|recipe| Manifest::load(recipe).unwrap().lambda.kind)
        .collect::<Vec<_>>();
    let count = |kind| kinds.iter().filter(|other| **other == kind).count();
    assert_eq!((count(LambdaKind::Wasm), count(LambdaKind::Python)), (5, 5));
}

#[test]
fn every_recipe_decides_as_expected_on_the_sample_drive() {
    let mut with_triggers = BTreeSet::new();
    for recipe in recipes() {
        let name = recipe.file_name().unwrap().to_string_lossy().into_owned();
        let expected = fs::read_to_string(recipe.join("expected.txt")).unwrap();
        let (command, rows) = expected.split_once('\n').unwrap_or((&expected, ""));
        let words: Vec<_> = command.split(' ').collect();
        let folder = format!("examples/cookbook/{name}");
        assert_eq!(
            words[..4],
            ["gleaner", "replay", &folder, "examples/data/highway_drive.mcap"],
            "{name}"
        );
        let run = replay(&recipe, &[sample_drive()], &words[4..]);
        run.must_exit(0);
        assert_eq!(run.rows(), rows, "{name}");
        if !rows.is_empty() {
            with_triggers.insert(name);
        }
    }
    // The events of the other recipes are not in the sample drive: the tests below insert them.
    let expected = ["dark-to-bright", "every-kilometre", "novelty", "pothole", "stopped"];
    assert_eq!(with_triggers, expected.map(str::to_owned).into());
}

#[test]
fn a_push_to_both_sides_is_a_swerve_and_a_bend_is_not() {
    let swerve = replay_changed("swerve", |message| {
        if is_within(message, IMU, 20.0, 21.0) {
            message.set(LATERAL, if message.at_s < 20.5 { 4.0 } else { -4.0 });
        }
        true
    });
    assert_eq!(triggers(&swerve), [("swerve".to_owned(), 20.9)]);
    let bend = replay_changed("swerve", |message| {
        if is_within(message, IMU, 20.0, 23.0) {
            message.set(LATERAL, 4.0);
        }
        true
    });
    assert_eq!(triggers(&bend), []);
}

#[test]
fn a_stop_is_recorded_from_its_third_second_until_the_car_moves() {
    let run = replay_changed("stopped", |message| {
        if is_within(message, SPEED, 12.0, 20.0) {
            message.set(FORWARD, 0.0);
        }
        true
    });
    assert_eq!(triggers(&run), [("stopped".to_owned(), 15.0), ("stopped".to_owned(), 20.0)]);
    let [clip] = &run.clips[..] else { panic!("{:?}", run.clips) };
    assert!((11.9..12.1).contains(&((clip.to_ns - clip.from_ns) as f64 / 1e9)), "{clip:?}");
}

#[test]
fn a_jump_of_speed_without_acceleration_is_a_mismatch() {
    let run = replay_changed("speed-mismatch", |message| {
        if is_within(message, SPEED, 20.0, 60.0) {
            message.set(FORWARD, 25.0);
        }
        true
    });
    assert_eq!(triggers(&run), [("speed-mismatch".to_owned(), 20.1)]);
}

#[test]
fn a_silent_sensor_is_reported_once_and_its_return_is_logged() {
    let run = replay_changed("sensor-silent", |message| !is_within(message, IMU, 10.0, 13.0));
    let found = triggers(&run);
    let [(label, at_s)] = &found[..] else { panic!("{found:?}") };
    assert!(label == "sensor-silent" && (10.9..=11.2).contains(at_s), "{at_s}");
    let trigger = run.decisions.iter().flat_map(|decision| &decision.triggers).next().unwrap();
    assert_eq!(trigger.attributes["topic"], IMU);
    let messages = run.log.iter().filter_map(|line| line["message"].as_str()).collect::<Vec<_>>();
    assert!(
        messages.iter().any(|line| line.starts_with("/imu/data is back after 3.")),
        "{messages:?}"
    );
}

#[test]
fn a_clock_jump_is_reported_once_and_a_late_sample_is_not() {
    let jumped = replay_changed("time-jump", |message| {
        if is_within(message, IMU, 20.0, 60.0) {
            message.shift_stamp(-2);
        }
        true
    });
    assert_eq!(triggers(&jumped), [("time-jump".to_owned(), 20.5)]);
    let trigger = jumped.decisions.iter().flat_map(|decision| &decision.triggers).next().unwrap();
    assert_eq!((trigger.score, trigger.attributes["jump_s"].as_f64()), (Some(2.0), Some(-2.0)));
    let mut late = 0;
    let run = replay_changed("time-jump", |message| {
        if is_within(message, IMU, 20.0, 20.03) {
            message.shift_stamp(-2);
            late += 1;
        }
        true
    });
    assert_eq!((late, triggers(&run)), (3, Vec::new()));
}

#[test]
fn a_frozen_image_is_reported_once_if_the_car_moves() {
    let freeze = |speed: Option<f64>| {
        let mut kept = Vec::new();
        replay_changed("frozen-image", move |message| {
            if is_within(message, CAMERA, 20.0, 22.0) {
                if kept.is_empty() {
                    kept.clone_from(&message.data);
                }
                message.data.clone_from(&kept);
            }
            if let Some(speed) = speed.filter(|_| message.topic == SPEED) {
                message.set(FORWARD, speed);
            }
            true
        })
    };
    assert_eq!(triggers(&freeze(None)), [("frozen-image".to_owned(), 20.5)]);
    assert_eq!(triggers(&freeze(Some(0.0))), []);
}
