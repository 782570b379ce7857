//! Drives in other formats: a lambda makes the same decisions over a rosbag2 directory as over the
//! same drive in MCAP.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_lambda::Manifest;
use gleaner_protocol::DriveInfo;
use gleaner_tests::bag::directory;
use gleaner_tests::drive::{IMAGE, changed, image, one_topic};
use gleaner_tests::readers::compare_clips;
use gleaner_tests::{
    LambdaCopy, ReplayRun, TempFolder, program, replay, replay_to, root, sample_drive, verify,
};

const OK: u8 = 0;
const USAGE: u8 = 2;
const DIFFERS: u8 = 4;
const DAMAGED: u8 = 7;

fn lambda(example: &str, kind: &str) -> PathBuf {
    root().join("examples").join(example).join(kind)
}

fn braking(lambda: &Path, drive: &Path, args: &[&str]) -> ReplayRun {
    replay(lambda, &[drive.to_owned()], &[&["--set", "brake_mps2=-1.4"], args].concat())
}

/// Time, topic and triggers of each decision, which do not depend on the storage of the drive.
fn decided(run: &ReplayRun) -> Vec<String> {
    run.decisions
        .iter()
        .map(|decision| format!("{} {:?} {:?}", decision.at_ns, decision.topic, decision.triggers))
        .collect()
}

#[test]
fn a_database_of_an_old_distribution_leads_to_the_same_decisions_and_clips() {
    let folder = TempFolder::new();
    let bag = directory(&folder, 1);
    for example in ["hello", "brake-dark"] {
        for kind in ["rust", "python"] {
            let lambda = lambda(example, kind);
            let (out, args) = (TempFolder::new(), ["--set", "brake_mps2=-1.4", "--all"]);
            let mcap = replay(&lambda, &[sample_drive()], &args);
            let bag_run = replay_to(out.path(), &lambda, std::slice::from_ref(&bag), &args);
            mcap.must_exit(OK);
            bag_run.must_exit(OK);
            assert!(mcap.decisions.len() > 300);
            assert_eq!(decided(&mcap), decided(&bag_run), "{example} in {kind}");
            let clips = |run: &ReplayRun| {
                run.clips.iter().map(|clip| (clip.first_ns, clip.last_ns)).collect::<Vec<_>>()
            };
            assert_eq!(clips(&mcap), clips(&bag_run), "{example} in {kind}");
            if kind == "rust" {
                compare_clips(out.path(), &[sample_drive()]);
            }
        }
    }
}

#[test]
fn a_compressed_drive_is_unpacked_beside_the_results_for_both_kinds() {
    let (folder, out) = (TempFolder::new(), TempFolder::new());
    let database = directory(&folder, 1).join("drive_0.db3");
    for (name, drive) in [("drive.mcap.zstd", sample_drive()), ("drive.db3.zstd", database)] {
        let packed =
            folder.write(name, zstd::encode_all(&fs::read(drive).unwrap()[..], 1).unwrap());
        for kind in ["rust", "python"] {
            let lambda = lambda("hello", kind);
            let args = ["--set", "brake_mps2=-1.4", "--all", "--repeat", "2"];
            let run = replay_to(out.path(), &lambda, std::slice::from_ref(&packed), &args);
            let plain = braking(&lambda, &sample_drive(), &["--all"]);
            assert_eq!(decided(run.must_exit(OK)), decided(&plain), "{name}, {kind}");
            let left = fs::read_dir(out.path())
                .unwrap()
                .map(|entry| entry.unwrap().file_name())
                .collect::<Vec<_>>();
            assert!(
                !left.iter().any(|name| name.to_string_lossy().contains("unpacked")),
                "{left:?}"
            );
        }
    }
}

#[test]
fn a_part_of_a_drive_lies_between_two_times() {
    let lambda = lambda("hello", "rust");
    let all = braking(&lambda, &sample_drive(), &["--all"]);
    let start_ns = all.summary.as_ref().unwrap().start_ns;
    let from = format!("@{}.{:09}", start_ns / 1_000_000_000 + 10, start_ns % 1_000_000_000);
    for from in ["10", "10s", "10000ms", from.as_str()] {
        let part = braking(&lambda, &sample_drive(), &["--all", "--from", from, "--to", "12.5"]);
        let span = start_ns + 10_000_000_000..start_ns + 12_500_000_000;
        let stamps: Vec<_> =
            part.must_exit(OK).decisions.iter().map(|decision| decision.at_ns).collect();
        let expected = all
            .decisions
            .iter()
            .map(|decision| decision.at_ns)
            .filter(|at_ns| span.contains(at_ns));
        assert!(expected.eq(stamps), "--from {from}");
        let summary = part.summary.as_ref().unwrap();
        // Times in the results are relative to the whole drive.
        assert_eq!((summary.start_ns, summary.part.from_ns), (start_ns, Some(span.start)));
    }
}

#[test]
fn an_empty_part_is_refused_with_the_length_of_the_drive() {
    let lambda = lambda("hello", "rust");
    for args in [["--from", "41"], ["--to", "0"], ["--from", "@9000000000"], ["--to", "@5"]] {
        let run = braking(&lambda, &sample_drive(), &args);
        run.must_exit(USAGE);
        for expected in
            ["no message in the requested range", args[0], "the drive is 39.993 s long", "from @"]
        {
            assert!(run.stderr.contains(expected), "{args:?}: {}", run.stderr);
        }
    }
    assert!(
        braking(&lambda, &sample_drive(), &["--from", "5", "--to", "5"])
            .must_exit(USAGE)
            .stderr
            .contains("--to")
    );
}

#[test]
fn clips_hold_the_topics_of_the_command_line() {
    let lambda = lambda("brake-dark", "rust");
    let kept = |args: &[&str]| {
        let run = braking(&lambda, &sample_drive(), args);
        let clip = &run.must_exit(OK).clips[0];
        clip.topics.iter().map(|topic| topic.topic.clone()).collect::<Vec<_>>()
    };
    assert_eq!(
        kept(&["--topics", "*"]),
        ["/camera/front/compressed", "/imu/data", "/vehicle/speed"]
    );
    assert_eq!(
        kept(&["--topics", "/v*d", "--topics", "/imu/data"]),
        ["/vehicle/speed", "/imu/data"]
    );
    let none = braking(&lambda, &sample_drive(), &["--topics", "/lidar/*"]);
    let stderr = &none.must_exit(USAGE).stderr;
    assert!(stderr.contains("no topic `/lidar/*`") && stderr.contains("`/imu/data`"), "{stderr}");
    let ticker = root().join("tests/lambdas/ticker/rust");
    let without = replay(&ticker, &[sample_drive()], &["--topics", "*"]);
    assert!(without.must_exit(USAGE).stderr.contains("[record]"), "{}", without.stderr);
}

#[test]
fn recorded_topics_do_not_change_the_times_of_ticks() {
    // The wheel speed begins 3 ms after the camera.
    let lambda = LambdaCopy::of("tests/lambdas/ticker/python", |manifest| {
        manifest
            .replace("/imu/data", "/vehicle/speed")
            .replace("sensor_msgs/msg/Imu", "geometry_msgs/msg/TwistStamped")
            + "\n[record]\ntopics = [\"/vehicle/speed\"]\npreroll = \"100ms\"\n\
               postroll = \"100ms\"\n"
    });
    lambda.replace("main.py", "def on_tick(ctx):\n    pass\n");
    let folder = TempFolder::new();
    let journal = folder.path().join("ticks.journal");
    let ticks = |args: &[&str]| {
        let run = replay(lambda.path(), &[sample_drive()], &[&["--all"], args].concat());
        run.must_exit(OK).decisions.iter().map(|decision| decision.at_ns).collect::<Vec<_>>()
    };
    let alone = ticks(&["--no-record"]);
    assert_eq!(alone.len(), 399, "every 100 ms of the drive, the first after 100 ms");
    assert_eq!(ticks(&[]), alone);
    assert_eq!(ticks(&["--topics", "*", "--journal", journal.to_str().unwrap()]), alone);
    let drive = sample_drive();
    let line = [
        OsStr::new("replay"),
        lambda.path().as_os_str(),
        drive.as_os_str(),
        "--verify".as_ref(),
        journal.as_os_str(),
    ];
    assert_eq!(verify(&line).verified.expect("the journal is verified").wakes, 399);
}

#[test]
fn a_journal_of_a_part_of_a_directory_is_verified_over_the_same_part() {
    let folder = TempFolder::new();
    let (bag, lambda) = (directory(&folder, 1), lambda("hello", "rust"));
    let journal = folder.path().join("part.journal");
    let journal_arg = journal.to_str().unwrap();
    braking(&lambda, &bag, &["--from", "5", "--to", "20", "--journal", journal_arg]).must_exit(OK);
    let again = |args: &[&str]| {
        let [lambda, bag] = [&lambda, &bag].map(|path| path.to_str().unwrap());
        let line = [&["replay", lambda, bag, "--verify", journal_arg], args].concat();
        verify(&line.iter().map(AsRef::as_ref).collect::<Vec<_>>())
    };
    let verified = again(&[]).verified.expect("the journal is verified");
    assert!(verified.wakes > 1000 && verified.wakes < 2000 && !verified.truncated, "{verified:?}");
    assert!(again(&["--from", "6"]).stderr.contains("cannot be used with"));
    // Every byte of the directory's files counts, even those that no lambda reads.
    let db = rusqlite::Connection::open(bag.join("drive_0.db3")).unwrap();
    db.execute("UPDATE schema SET ros_distro = 'jammed'", []).unwrap();
    drop(db);
    let changed = again(&[]);
    assert_eq!(changed.exit, i32::from(DIFFERS), "{}", changed.stderr);
    assert!(changed.stderr.contains("drive `drive_0.db3`"), "{}", changed.stderr);
}

#[test]
fn a_truncated_database_keeps_the_decisions_before_its_end() {
    let folder = TempFolder::new();
    let bag = directory(&folder, 1);
    let path = bag.join("drive_0.db3");
    let bytes = fs::read(&path).unwrap();
    // After the pages that all others depend on.
    fs::write(&path, &bytes[..bytes.len() / 10 * 9]).unwrap();
    let run = braking(&lambda("hello", "rust"), &bag, &["--no-record"]);
    let summary = run.must_exit(DAMAGED).summary.as_ref().unwrap();
    assert!(summary.wakes > 1000, "{}", summary.wakes);
    let damaged = summary.damaged.as_deref().unwrap();
    for expected in [
        "drive_0.db3` is damaged at the message after number",
        "it was truncated",
        "of 4170 messages, up to",
        "results up to the damage are kept",
        ".recover",
    ] {
        assert!(damaged.contains(expected), "{damaged}");
    }
}

#[test]
fn messages_with_a_stamp_out_of_range_are_left_out_and_counted() {
    let folder = TempFolder::new();
    let mut late = 0;
    let drive = changed(&folder, |message| {
        late += u64::from(message.at_s > 30.0 && message.topic == "/imu/data");
        message.log_time |= u64::from(message.at_s > 30.0) << 63;
        true
    });
    let run = braking(&lambda("hello", "rust"), &drive, &["--no-record", "--all"]);
    let summary = run.must_exit(0).summary.as_ref().unwrap();
    assert!(
        summary.wakes > 1000 && run.decisions.iter().all(|decision| decision.at_ns < i64::MAX),
        "{summary:?}"
    );
    assert_eq!(summary.malformed, [("/imu/data".to_owned(), late)].into());
}

#[test]
fn a_directory_that_cannot_be_used_is_refused_with_cause_and_help() {
    let (folder, lambda) = (TempFolder::new(), lambda("hello", "rust"));
    let bag = directory(&folder, 1);
    folder.write(
        "drive/metadata.yaml",
        "rosbag2_bagfile_information:\n  storage_identifier: bag_v2\n",
    );
    let run = braking(&lambda, &bag, &[]);
    run.must_exit(USAGE);
    for expected in [
        "error: cannot use `",
        "metadata.yaml`",
        "cause: its storage is `bag_v2`",
        "help:  ",
        "ros2 bag reindex",
    ] {
        assert!(run.stderr.contains(expected), "{}", run.stderr);
    }
    fs::remove_file(bag.join("metadata.yaml")).unwrap();
    let run = braking(&lambda, &bag, &["--no-record"]);
    assert_eq!(run.must_exit(OK).stderr.matches("no metadata.yaml").count(), 1, "{}", run.stderr);
    let twice = replay(&lambda, &[bag.clone(), bag.join("drive_0.db3")], &[]);
    assert!(twice.must_exit(USAGE).stderr.contains("is given twice"), "{}", twice.stderr);
}

#[test]
fn files_that_the_metadata_omit_are_named() {
    let (folder, lambda) = (TempFolder::new(), lambda("hello", "rust"));
    let bag = directory(&folder, 1);
    assert!(!braking(&lambda, &bag, &["--no-record"]).must_exit(OK).stderr.contains("are skipped"));
    // The same file, compressed later: nothing is omitted.
    folder.write("drive/drive_0.db3.zstd", "");
    assert!(!braking(&lambda, &bag, &["--no-record"]).must_exit(OK).stderr.contains("are skipped"));
    fs::copy(bag.join("drive_0.db3"), bag.join("drive_1.db3")).unwrap();
    let run = braking(&lambda, &bag, &["--no-record"]);
    assert!(run.must_exit(OK).stderr.contains("1 are skipped"), "{}", run.stderr);
    assert!(run.stderr.contains("drive_1.db3"), "{}", run.stderr);
}

#[test]
fn long_gaps_and_hostile_sizes_in_a_drive_are_shown_unchanged() {
    let message = || image(u32::MAX, u32::MAX, "rgb8", 3, &[0; 3]);
    for (last, gap) in
        [(7_200_000_000_001, "  7200000.0 ms  "), (i64::MAX as u64, "  9223372036854.8 ms  ")]
    {
        let folder = TempFolder::new();
        let messages = [(1, message()), (last, message())];
        let drive = one_topic(&folder, "/camera", "sensor_msgs/msg/Image", IMAGE, &messages);
        let output = Command::new(program("gleaner")).arg("inspect").arg(drive).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(text.contains(gap) && text.contains("rgb8 4294967295x4294967295"), "{text}");
    }
}

#[test]
fn the_content_of_a_drive_is_shown_without_a_lambda() {
    let folder = TempFolder::new();
    let bag = directory(&folder, 1);
    let topics = |args: &[&str]| {
        let output = Command::new(program("gleaner")).arg("inspect").args(args).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned())
    };
    for drive in [bag, sample_drive()] {
        let (code, json) = topics(&[drive.to_str().unwrap(), "--json"]);
        assert_eq!(code, Some(0));
        let seen: DriveInfo = serde_json::from_str(&json).unwrap();
        let found: Vec<_> = seen
            .topics
            .iter()
            .map(|topic| (topic.topic.as_str(), topic.messages, topic.is_defined))
            .collect();
        let expected =
            [("/camera/front/compressed", 400), ("/imu/data", 4170), ("/vehicle/speed", 3316)];
        assert_eq!(found, expected.map(|(topic, messages)| (topic, Some(messages), true)));
        let (_, text) = topics(&[drive.to_str().unwrap()]);
        assert!(text.contains("/imu/data") && text.contains("4,170"), "{text}");
        let imu = &seen.topics[1];
        let interval = imu.interval.unwrap();
        assert_eq!(
            (imu.messages_read, interval.n, imu.missing, imu.largest_bytes),
            (4170, 4169, Some(0), 320)
        );
        assert!((9_500_000..9_700_000).contains(&interval.p50_ns), "{interval:?}");
        let picture = seen.topics[0].picture.clone().unwrap();
        assert_eq!((picture.width, picture.height, picture.is_compressed), (640, 360, true));
        // The suggested tables are valid in a manifest.
        let lambda =
            "lambda = { name = 'x', version = '0.1.0', kind = 'python', entry = 'main.py' }\n";
        let (_, tables) = text.split_once("for lambda.toml:\n").unwrap();
        let manifest = folder.path().join("suggested");
        folder.write("suggested/lambda.toml", format!("{lambda}schedule.event = 'imu'\n{tables}"));
        assert_eq!(Manifest::load(&manifest).unwrap().inputs.len(), 3);
    }
    assert_eq!(topics(&["nowhere.mcap"]).0, Some(i32::from(USAGE)));
}
