//! Drives with odd content, as in public bug reports: each value is right, or it is refused.

use std::path::PathBuf;

use gleaner_tests::drive::latched_imu;
use gleaner_tests::readers::compare_clips;
use gleaner_tests::{LambdaCopy, ReplayRun, TempFolder, replay_to, root, verify_clip};
use libtest_mimic::{Failed, Trial};

use crate::clips::same;

/// Logs the fields of `config.fields` of each sample.
const READER: &str = r#"
class Lambda:
    def __init__(self, ctx):
        self.fields = [ctx.input("imu").field(path) for path in ctx.config["fields"].split()]

    def on_event(self, ctx, event):
        ctx.event("read", 1.0, values=" ".join(str(event.get(field)) for field in self.fields))
"#;

pub fn trials() -> Vec<Trial> {
    vec![
        Trial::test("messages_of_two_layouts_are_read_each_by_its_own", two_layouts),
        Trial::test("a_field_that_only_one_layout_has_is_refused_with_both", differing_field),
        Trial::test("one_odd_message_or_topic_costs_no_other", odd_topics),
        Trial::test("an_empty_file_of_a_recording_is_skipped", empty_file),
        Trial::test("two_drives_of_one_time_are_refused_unless_merged", two_drives),
        Trial::test("damage_before_a_part_is_not_reported_as_its_end", damaged_before),
    ]
}

fn case(name: &str) -> PathBuf {
    root().join("tests/data/cases").join(name)
}

/// A lambda that reads `fields` of `topic`, and records all topics of the drive.
fn reader(topic: &str, type_name: &str, fields: &str) -> LambdaCopy {
    let lambda = LambdaCopy::of("examples/hello/python", |manifest| {
        let manifest = manifest
            .replace(
                "\"/imu/data\"\ntype = \"sensor_msgs/msg/Imu\"",
                &format!("\"{topic}\"\ntype = \"{type_name}\""),
            )
            .replace("deadline = \"10ms\"\n", "");
        let (before, _) = manifest.split_once("[config]").unwrap_or((&manifest, ""));
        format!("{before}[config]\nfields = \"{fields}\"\n")
    });
    lambda.replace("main.py", READER);
    lambda
}

/// Replays drives with a reader, and clips of all topics. Third-party readers compare these with
/// the drives, unless they refuse the names of actions and services.
fn read(lambda: &LambdaCopy, drives: &[PathBuf]) -> (TempFolder, ReplayRun) {
    let out = TempFolder::new();
    // Some of them follow each other in time, and are one drive only by request.
    let run = replay_to(out.path(), lambda.path(), drives, &["--topics", "*", "--merge"]);
    if run.exit == 0 && drives != [case("14_service_events_raw_srv_schema.mcap")] {
        compare_clips(out.path(), drives);
    }
    (out, run)
}

fn values(run: &ReplayRun) -> Vec<String> {
    let triggers = run.decisions.iter().flat_map(|decision| &decision.triggers);
    triggers
        .flat_map(|trigger| trigger.attributes.iter())
        .map(|(_, value)| serde_json::to_value(value).unwrap_or_default())
        .map(|value| value.as_str().map_or_else(|| value.to_string(), str::to_owned))
        .collect()
}

const WHEELS: (&str, &str) = ("/wheels", "car_msgs/msg/WheelSpeeds");

fn two_layouts() -> Result<(), Failed> {
    // The foreign readers give 10 to 19 and 20 to 29 for these drives.
    let expected: Vec<_> = (0..10).map(|n| format!("{}.0 {}.0", 10 + n, 20 + n)).collect();
    let lambda = reader(WHEELS.0, WHEELS.1, "front_left front_right");
    let both = [case("01b_new.mcap"), case("01b_old.mcap")];
    let turned = [case("01b_old.mcap"), case("01b_new.mcap")];
    for drives in [
        &[case("01a_two_definitions_one_file.mcap")][..],
        &[case("01c_same_layout_other_comments.mcap")],
        &both,
        &turned,
    ] {
        let (out, run) = read(&lambda, drives);
        same(&(run.exit, values(&run)), &(0, expected.clone()))?;
        // A clip is a drive with two layouts, too.
        for clip in &run.clips {
            let verified = verify_clip(&out.path().join(&clip.file), lambda.path());
            same(&(verified.exit, verified.stderr.as_str()), &(0, ""))?;
        }
    }
    Ok(())
}

fn differing_field() -> Result<(), Failed> {
    let lambda = reader(WHEELS.0, WHEELS.1, "status");
    let (_out, run) = read(&lambda, &[case("01a_two_definitions_one_file.mcap")]);
    let expected = "`status` does not mean the same in all layouts of `car_msgs/msg/WheelSpeeds` on \
                    this topic: in that with the fields `front_left`, `front_right`, ";
    same(&(run.exit, run.stderr.contains(expected)), &(6, true))
}

fn odd_topics() -> Result<(), Failed> {
    let x = "linear_acceleration.x";
    for (drive, malformed, named) in [
        ("02_two_types_one_topic", None, "left_out=std_msgs/msg/Float64"),
        ("08b_zero_length_message", Some("/text"), "it begins with []"),
        ("18_pl_cdr", Some("/x"), "it begins with [00, 03, 00, 00]"),
        ("18_xcdr2_delimited", Some("/x"), "it begins with [00, 09, 00, 00]"),
        ("18_xcdr2_plain", Some("/x"), "it begins with [00, 07, 00, 00]"),
        ("14_service_events_raw_srv_schema", None, ""),
        ("15_ros2idl", None, "/control/lateral"),
    ] {
        let lambda = reader("/imu", "sensor_msgs/msg/Imu", x);
        let (_out, run) = read(&lambda, &[case(drive).with_extension("mcap")]);
        let summary = run.summary.as_ref().ok_or_else(|| format!("{drive}: {}", run.stderr))?;
        let odd: Vec<_> = summary.malformed.keys().map(String::as_str).collect();
        same(
            &(drive, run.exit, values(&run).len(), odd, run.stderr.contains(named)),
            &(drive, 0, 10, malformed.into_iter().collect(), true),
        )?;
    }
    Ok(())
}

fn empty_file() -> Result<(), Failed> {
    let lambda = reader("/imu", "sensor_msgs/msg/Imu", "linear_acceleration.x");
    let (_out, run) = read(&lambda, &[case("split_zero_byte_last")]);
    let is_named = run.stderr.contains("s_1.mcap");
    same(&(run.exit, values(&run).len(), is_named), &(0, 20, true))?;
    let (_out, run) = read(&lambda, &[case("split_zero_byte_last/s_1.mcap")]);
    same(&(run.exit, run.stderr.contains("s_1.mcap` is empty: its recorder")), &(2, true))
}

fn two_drives() -> Result<(), Failed> {
    let lambda = reader("/imu", "sensor_msgs/msg/Imu", "linear_acceleration.x");
    let drives = [case("15_ros2idl.mcap"), case("18_pl_cdr.mcap")];
    let out = TempFolder::new();
    let run = replay_to(out.path(), lambda.path(), &drives, &["--no-record"]);
    same(&(run.exit, run.stderr.contains("pass --merge")), &(2, true))?;
    let run = replay_to(out.path(), lambda.path(), &drives, &["--no-record", "--merge"]);
    same(&(run.exit, values(&run).len()), &(0, 20))
}

fn damaged_before() -> Result<(), Failed> {
    let lambda = reader("/imu", "sensor_msgs/msg/Imu", "linear_acceleration.x");
    let (folder, out) = (TempFolder::new(), TempFolder::new());
    let drive = latched_imu(&folder, 10);
    let part = || {
        let args = ["--from", "5", "--no-record"];
        replay_to(out.path(), lambda.path(), std::slice::from_ref(&drive), &args)
    };
    // By the formula of these messages: the 26th number after the header.
    let expected =
        |from: u32| (from..=10).map(|n| format!("{}.25", 100 * n + 25)).collect::<Vec<_>>();
    let whole = part();
    same(&(whole.exit, values(&whole)), &(0, expected(1)))?;
    let mut bytes = std::fs::read(&drive)?;
    let first = bytes.windows(8).position(|window| window == b"frame_1\0");
    bytes[first.ok_or("the first message is not there")?] ^= 1;
    std::fs::write(&drive, bytes)?;
    let damaged = part();
    same(&(damaged.exit, values(&damaged)), &(7, expected(6)))?;
    // What is missing came before: nothing later is lost.
    let shown = damaged.summary.and_then(|summary| summary.damaged).unwrap_or_default();
    let is_right = shown.contains("latched") && !shown.contains("later messages are lost");
    if is_right { Ok(()) } else { Err(shown.into()) }
}
