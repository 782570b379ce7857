//! Drives with many topics, and with topics that cannot be read: inspection, clips, refusals.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::PathBuf;
use std::process::Command;

use gleaner_protocol::{DriveInfo, Report};
use gleaner_tests::drive::with_topics;
use gleaner_tests::{ReplayRun, TempFolder, program, replay, root, sample_drive};

const USAGE: u8 = 2;
/// Limit of address space. At 82 KiB for each topic, 12,000 topics would exceed it.
const ADDRESSES_KIB: u32 = 1 << 20;

fn braking(drives: &[PathBuf], args: &[&str]) -> ReplayRun {
    let lambda = root().join("examples/hello/rust");
    replay(&lambda, drives, &[&["--set", "brake_mps2=-1.4"], args].concat())
}

#[test]
fn a_file_of_sixty_thousand_topics_is_inspected_in_bounded_memory() {
    let folder = TempFolder::new();
    let drive = with_topics(&folder, 60_000);
    let line = format!("ulimit -v {ADDRESSES_KIB}; exec \"$0\" \"$@\"");
    let mut inspect = Command::new("sh");
    inspect.args(["-c", line.as_str()]).arg(program("gleaner-runtime")).arg("inspect").arg(&drive);
    let output = inspect.output().expect("a shell starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let reports = String::from_utf8_lossy(&output.stdout);
    let Some(Ok(Report::Drive(seen))) = reports.lines().map(serde_json::from_str).next_back()
    else {
        panic!("{reports}")
    };
    let DriveInfo { topics, skipped, .. } = seen;
    assert_eq!(topics.len() as u64 + skipped, 60_001);
    assert_eq!(skipped, 60_001 - 4096);
    let imu = topics
        .iter()
        .find(|topic| topic.topic == "/imu/data")
        .expect("it is among the first names");
    assert_eq!((imu.messages_read, imu.messages), (4170, Some(4170)));
    assert!(
        topics
            .iter()
            .filter(|topic| topic.topic != "/imu/data")
            .all(|topic| topic.messages_read == 10)
    );
}

#[test]
fn topics_with_messages_are_inspected_before_those_without() {
    let folder = TempFolder::new();
    let mut file = Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new().create(&mut file).unwrap();
    let schema = writer.add_schema("std_msgs/msg/String", "ros2msg", b"string data").unwrap();
    for n in 0..5000 {
        writer.add_channel(schema, &format!("/empty/{n}"), "cdr", &BTreeMap::new()).unwrap();
    }
    let channel_id = writer.add_channel(schema, "/last", "cdr", &BTreeMap::new()).unwrap();
    let header =
        mcap::records::MessageHeader { channel_id, sequence: 1, log_time: 5, publish_time: 5 };
    writer.write_to_known_channel(&header, &[0, 1, 0, 0, 1, 0, 0, 0, 0]).unwrap();
    writer.finish().unwrap();
    drop(writer);
    let drive = folder.write("sparse.mcap", file.into_inner());
    let output = Command::new(program("gleaner")).arg("inspect").arg(drive).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("/last ") && text.contains("and 905 more topics, not read"), "{text}");
}

#[test]
fn clips_hold_all_topics_of_a_drive_of_five_hundred() {
    let folder = TempFolder::new();
    let run = braking(&[with_topics(&folder, 500)], &["--topics", "*"]);
    let clips = &run.must_exit(0).clips;
    assert_eq!(clips.len(), 2);
    for clip in clips {
        assert_eq!(clip.topics.len(), 501);
        assert!(
            clip.topics.iter().all(|topic| topic.messages > 0 && topic.overwritten == Some(0)),
            "{clip:?}"
        );
    }
}

#[test]
fn more_topics_than_clips_can_hold_are_refused_before_reading() {
    let folder = TempFolder::new();
    let drive = with_topics(&folder, 2000);
    let run = braking(std::slice::from_ref(&drive), &["--topics", "*"]);
    let stderr = &run.must_exit(USAGE).stderr;
    assert!(stderr.contains("--topics chooses 2001 topics; clips hold at most 1024"), "{stderr}");
    assert!(stderr.contains("help:  choose fewer: --topics PATTERN"), "{stderr}");
    // The message lists only some of them.
    let none = braking(&[drive], &["--topics", "/lidar/*"]);
    let stderr = &none.must_exit(USAGE).stderr;
    assert!(
        stderr.contains("the drive has no topic `/lidar/*`") && stderr.contains("and 1981 more"),
        "{stderr}"
    );
    assert!(stderr.len() < 2000, "{stderr}");
}

#[test]
fn a_pattern_without_readable_topics_is_refused_with_those_that_are() {
    let folder = TempFolder::new();
    let mut file = Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new().create(&mut file).unwrap();
    let channel_id = writer.add_channel(0, "/notes", "json", &BTreeMap::new()).unwrap();
    let at = 1_533_199_500_000_000_000;
    let header =
        mcap::records::MessageHeader { channel_id, sequence: 1, log_time: at, publish_time: at };
    writer.write_to_known_channel(&header, b"{}").unwrap();
    writer.finish().unwrap();
    drop(writer);
    let drives = [sample_drive(), folder.write("notes.mcap", file.into_inner())];
    for pattern in ["/notes", "/no*"] {
        let run = braking(&drives, &["--merge", "--topics", pattern]);
        let stderr = &run.must_exit(USAGE).stderr;
        assert!(
            stderr.contains(&format!(
                "error: no topic that --topics `{pattern}` matches can be recorded"
            )),
            "{stderr}"
        );
        assert!(stderr.contains("cause: topic `/notes` has message encoding `json`"), "{stderr}");
        assert!(
            stderr.contains("help:  the drive has `/camera/front/compressed`, `/imu/data`"),
            "{stderr}"
        );
    }
    let all = braking(&drives, &["--merge", "--topics", "*"]);
    assert_eq!(all.must_exit(0).clips[0].topics.len(), 3);
    assert!(all.stderr.contains("clips are made without this topic"), "{}", all.stderr);
}
