//! Verifying a journal repeats every decision, and names anything that has changed since.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use gleaner_tests::readers::compare_clips;
use gleaner_tests::{
    LambdaCopy, ReplayRun, TempFolder, Verification, replay_to, root, sample_drive, verify,
    verify_clip,
};

const HELLO: &str = "examples/hello/rust";
const BRAKING: [&str; 2] = ["--set", "brake_mps2=-1.4"];

struct JournaledRun {
    out: TempFolder,
    journal: PathBuf,
    run: ReplayRun,
}

fn journaled(lambda: &Path, drive: &Path, args: &[&str]) -> JournaledRun {
    let out = TempFolder::new();
    let journal = out.path().join("wakes.journal");
    let args = [args, &["--journal", journal.to_str().unwrap()]].concat();
    let run = replay_to(out.path(), lambda, &[drive.to_owned()], &args);
    JournaledRun { out, journal, run }
}

pub(super) fn verify_drive(
    lambda: &Path,
    drive: &Path,
    journal: &Path,
    args: &[&str],
) -> Verification {
    let mut line: Vec<&OsStr> =
        vec!["replay".as_ref(), lambda.as_ref(), drive.as_ref(), "--verify".as_ref()];
    line.push(journal.as_ref());
    line.extend(args.iter().map(OsStr::new));
    verify(&line)
}

#[track_caller]
fn differs(verification: &Verification, exit: u8, words: &[&str]) {
    assert_eq!(verification.exit, i32::from(exit), "{}", verification.stderr);
    for word in words {
        assert!(verification.stderr.contains(word), "no `{word}` in:\n{}", verification.stderr);
    }
    assert!(verification.verified.is_none());
}

/// The sample drive with a changed byte in its `n`th IMU message and correct checksums.
fn forged(folder: &TempFolder, n: usize) -> PathBuf {
    let bytes = std::fs::read(sample_drive()).unwrap();
    let mut file = Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new().profile("ros2").create(&mut file).unwrap();
    let (mut channels, mut imu) = (BTreeMap::new(), 0);
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let mut message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        let channel = *channels.entry(message.channel.topic.clone()).or_insert_with(|| {
            let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data).unwrap();
            writer.add_channel(schema, &message.channel.topic, "cdr", &BTreeMap::new()).unwrap()
        });
        if message.channel.topic == "/imu/data" {
            if imu == n {
                let data = message.data.to_mut();
                let last = data.len() - 1;
                data[last] ^= 1;
            }
            imu += 1;
        }
        let mcap::Message { sequence, log_time, publish_time, .. } = message;
        let header =
            mcap::records::MessageHeader { channel_id: channel, sequence, log_time, publish_time };
        writer.write_to_known_channel(&header, &message.data).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    folder.write(&format!("forged-{n}.mcap"), file.into_inner())
}

/// Replays with a journal and verifies it; returns the number of faults, and of wakes skipped by
/// back-off.
fn verified(lambda: &Path, args: &[&str]) -> (u64, u64) {
    let journaled = journaled(lambda, &sample_drive(), args);
    assert!([0, 6].contains(&journaled.run.exit), "{}", journaled.run.stderr);
    let summary = journaled.run.summary.unwrap();
    let again = verify_drive(lambda, &sample_drive(), &journaled.journal, &[]);
    let verified =
        again.verified.unwrap_or_else(|| panic!("{} {args:?}: {}", lambda.display(), again.stderr));
    assert_eq!((verified.wakes, verified.triggers), (summary.wakes, summary.triggers));
    assert_eq!((verified.uncovered, verified.truncated, verified.notes), (0, false, Vec::new()));
    (summary.faults, summary.backed_off)
}

#[test]
fn every_decision_of_every_lambda_is_repeated() {
    let lambdas: [(&str, &[&str]); 5] = [
        ("examples/hello", &BRAKING),
        ("examples/brake-dark", &BRAKING),
        ("examples/imu-fft", &[]),
        ("tests/lambdas/probe", &[]),
        ("tests/lambdas/ticker", &[]),
    ];
    for (lambda, args) in lambdas {
        for kind in ["rust", "python"] {
            let lambda = root().join(lambda).join(kind);
            assert_eq!(verified(&lambda, args), (0, 0));
        }
    }
}

#[test]
fn every_fault_is_repeated() {
    let faults = [
        "error",
        "panic",
        "event_then_error",
        "event_then_panic",
        "huge_label",
        "too_many_triggers",
        "nan_score",
    ];
    let wasm_faults = ["endless", "memory", "recurse"];
    for (kind, behaviours) in
        [("rust", [&faults[..], &wasm_faults].concat()), ("python", faults.to_vec())]
    {
        for behaviour in behaviours {
            let lambda = root().join("tests/lambdas/misbehave").join(kind);
            let (faults, backed_off) =
                verified(&lambda, &["--set", &format!("behaviour={behaviour}")]);
            assert!(faults > 8, "{behaviour} in {kind} faulted {faults} times");
            assert!(
                faults + backed_off > 4000,
                "{behaviour} in {kind} backed off in {backed_off} wakes"
            );
        }
        for behaviour in ["hold", "log_flood", "print"] {
            verified(
                &root().join("tests/lambdas/misbehave").join(kind),
                &["--set", &format!("behaviour={behaviour}")],
            );
        }
    }
}

#[test]
fn a_changed_sample_is_found_with_its_input_and_its_wake() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let folder = TempFolder::new();
    for n in [0, 1000, 4169] {
        let again = verify_drive(&root().join(HELLO), &forged(&folder, n), &journaled.journal, &[]);
        let wake = format!("wake {} of lambda `hello`", n + 1);
        differs(&again, 4, &[&wake, "input `imu`", "in the journal:", "now:"]);
    }
}

#[test]
fn a_flipped_byte_anywhere_in_the_drive_is_found() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let (folder, complete) = (TempFolder::new(), std::fs::read(sample_drive()).unwrap());
    for part in 0..24 {
        let at = complete.len() / 24 * part + part * 131;
        let mut bytes = complete.clone();
        bytes[at] ^= 0x10;
        let drive = folder.write("flipped.mcap", &bytes);
        let again = verify_drive(&root().join(HELLO), &drive, &journaled.journal, &[]);
        assert!(
            [2, 4, 7].contains(&again.exit),
            "flip at {at}: exit {} {}",
            again.exit,
            again.stderr
        );
        assert!(again.stderr.contains("flipped.mcap"), "flip at {at}: {}", again.stderr);
    }
}

#[test]
fn another_build_is_named_by_the_file_that_changed() {
    for (lambda, file) in [(HELLO, "hello.wasm"), ("examples/hello/python", "main.py")] {
        let copy = LambdaCopy::of(lambda, |manifest| manifest);
        let journaled = journaled(copy.path(), &sample_drive(), &BRAKING);
        assert_eq!(journaled.run.exit, 0, "{}", journaled.run.stderr);
        let path = copy.path().join("build").join(file);
        let mut bytes = std::fs::read(&path).unwrap();
        // In a comment, a name or a custom section: the lambda would still run in the same way.
        let last = bytes.len() - 1;
        bytes[last] = if file.ends_with("wasm") { bytes[last] ^ 1 } else { b' ' };
        copy.replace(file, &bytes);
        let again = verify_drive(copy.path(), &sample_drive(), &journaled.journal, &[]);
        differs(&again, 4, &["not the lambda that wrote the journal", file, "in the journal:"]);
    }
}

#[test]
fn a_changed_manifest_is_found_and_a_changed_record_table_is_accepted() {
    let copy = LambdaCopy::of(HELLO, |manifest| manifest);
    let journaled = journaled(copy.path(), &sample_drive(), &BRAKING);
    let manifest = std::fs::read_to_string(copy.path().join("build/lambda.toml")).unwrap();
    copy.replace(
        "lambda.toml",
        manifest.replace("preroll = \"5s\"", "preroll = \"7s\"").replace("hard braking", "dip"),
    );
    assert_eq!(verify_drive(copy.path(), &sample_drive(), &journaled.journal, &[]).exit, 0);
    for (was, is, what) in [
        ("fuel = 10_000_000", "fuel = 9_000_000", "limit `fuel`"),
        ("depth = ", "hold = 3\ndepth = ", "manifest lambda.toml"),
    ] {
        assert!(manifest.contains(was), "{was}");
        copy.replace("lambda.toml", manifest.replace(was, is));
        let again = verify_drive(copy.path(), &sample_drive(), &journaled.journal, &[]);
        differs(&again, 4, &["not the lambda that wrote the journal", what]);
    }
}

#[test]
fn canonical_nans_are_recorded_in_the_journal() {
    let at = |toml: &str| toml.replace("kind = \"wasm\"", "kind = \"wasm\"\ndeterministic = true");
    let copy = LambdaCopy::of(HELLO, |toml| at(&toml));
    let journaled = journaled(copy.path(), &sample_drive(), &BRAKING);
    assert_eq!(journaled.run.exit, 0, "{}", journaled.run.stderr);
    // Its native code differs and has another cache entry; its decisions are equal, because it
    // uses no NaN.
    let plain = self::journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    assert_eq!(journaled.run.labels(), plain.run.labels());
    let names = |journal: &Path| {
        let bytes = std::fs::read(journal).unwrap();
        bytes.windows(14).any(|bytes| bytes == b"canonical NaNs")
    };
    assert!(names(&journaled.journal) && !names(&plain.journal));
    assert_eq!(verify_drive(copy.path(), &sample_drive(), &journaled.journal, &[]).exit, 0);
    let again = verify_drive(&root().join(HELLO), &sample_drive(), &journaled.journal, &[]);
    differs(&again, 4, &["not the lambda that wrote the journal", "manifest lambda.toml"]);
}

#[test]
fn a_changed_config_is_named_by_its_key_and_the_recorded_one_is_the_default() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let again = |args: &[&str]| {
        verify_drive(&root().join(HELLO), &sample_drive(), &journaled.journal, args)
    };
    assert_eq!(again(&BRAKING).exit, 0);
    differs(&again(&["--set", "brake_mps2=-1.5"]), 4, &["config `brake_mps2`", "-1.4", "-1.5"]);
}

#[test]
fn a_flipped_byte_in_the_journal_is_found() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let complete = std::fs::read(&journaled.journal).unwrap();
    for part in 0..16 {
        let at = complete.len() / 16 * part + part;
        let mut bytes = complete.clone();
        bytes[at] ^= 0x04;
        let changed = journaled.out.write("changed.journal", &bytes);
        let again = verify_drive(&root().join(HELLO), &sample_drive(), &changed, &[]);
        differs(&again, 2, &["changed.journal"]);
    }
}

#[test]
fn a_journal_of_a_killed_process_verifies_its_complete_wakes() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let complete = std::fs::read(&journaled.journal).unwrap();
    let cut = journaled.out.write("cut.journal", &complete[..complete.len() * 9 / 10]);
    let again = verify_drive(&root().join(HELLO), &sample_drive(), &cut, &[]);
    let verified = again.verified.unwrap_or_else(|| panic!("{}", again.stderr));
    assert!(verified.truncated && verified.wakes > 100 && verified.wakes < 4170, "{verified:?}");
}

#[test]
fn a_journal_without_a_complete_wake_is_refused() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let complete = std::fs::read(&journaled.journal).unwrap();
    let cut = journaled.out.write("cut.journal", &complete[..2000]);
    let again = verify_drive(&root().join(HELLO), &sample_drive(), &cut, &[]);
    differs(&again, 2, &["cut.journal", "no complete wake"]);
}

#[test]
fn the_wrong_drive_and_a_clip_in_the_place_of_a_journal_are_named() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let folder = TempFolder::new();
    let again = verify_drive(&root().join(HELLO), &forged(&folder, 9), &journaled.journal, &[]);
    differs(&again, 4, &["wake 10 of", "drive `forged-9.mcap`", "CRC-32"]);
    let clip = journaled.out.path().join(&journaled.run.clips[0].file);
    let again = verify_drive(&root().join(HELLO), &sample_drive(), &clip, &[]);
    differs(&again, 2, &["gleaner verify CLIP --lambda DIR"]);
}

#[test]
fn a_clip_verifies_its_decisions_and_counts_those_it_cannot() {
    for kind in ["rust", "python"] {
        for example in ["hello", "brake-dark"] {
            let lambda = root().join("examples").join(example).join(kind);
            let journaled = journaled(&lambda, &sample_drive(), &BRAKING);
            compare_clips(journaled.out.path(), &[sample_drive()]);
            assert!(!journaled.run.clips.is_empty());
            for clip in &journaled.run.clips {
                let again = verify_clip(&journaled.out.path().join(&clip.file), &lambda);
                let verified = again
                    .verified
                    .unwrap_or_else(|| panic!("{example} in {kind}: {}", again.stderr));
                assert!(
                    verified.wakes > 50 && verified.uncovered < verified.wakes / 2,
                    "{verified:?}"
                );
                // The window of the first wakes, half a second, begins before the clip, unless the
                // clip begins with the drive.
                let from_the_start =
                    clip.first_ns == journaled.run.summary.as_ref().map(|summary| summary.start_ns);
                assert_eq!(verified.uncovered == 0, from_the_start, "{verified:?}");
            }
        }
    }
}

#[test]
fn a_clip_without_a_topic_that_the_lambda_reads_cannot_be_verified() {
    let lambda = LambdaCopy::of("examples/brake-dark/rust", |manifest| {
        manifest.replace("\"/imu/data\", ", "")
    });
    let journaled = journaled(lambda.path(), &sample_drive(), &BRAKING);
    let clip = journaled.out.path().join(&journaled.run.clips[0].file);
    differs(&verify_clip(&clip, lambda.path()), 2, &["/imu/data", "[record]", "--verify"]);
}

#[test]
fn a_clip_that_covers_no_trigger_cannot_be_verified() {
    // hello looks back half a second.
    let lambda = LambdaCopy::of(HELLO, |manifest| {
        manifest.replace("preroll = \"5s\"", "preroll = \"100ms\"")
    });
    let journaled = journaled(lambda.path(), &sample_drive(), &BRAKING);
    let clip = journaled.out.path().join(&journaled.run.clips[2].file);
    differs(&verify_clip(&clip, lambda.path()), 2, &["proves no trigger", "preroll", "--verify"]);
}

#[test]
fn a_clip_of_a_lambda_over_its_log_rate_limit_can_be_verified() {
    let lambda = LambdaCopy::of("tests/lambdas/misbehave/rust", |manifest| {
        let record = "[record]\ntopics = [\"/imu/data\"]\npreroll = \"2s\"\n\
                      postroll = \"0s\"\ncooldown = \"30s\"\n";
        format!("{manifest}\n{record}")
    });
    // It triggers and then faults in every wake, so that each wake has a new instance.
    let journaled =
        journaled(lambda.path(), &sample_drive(), &["--set", "behaviour=event_then_error"]);
    assert!(journaled.run.clips.len() >= 2);
    let clip = journaled.out.path().join(&journaled.run.clips[1].file);
    let again = verify_clip(&clip, lambda.path());
    let verified = again.verified.unwrap_or_else(|| panic!("{}", again.stderr));
    assert!(verified.triggers > verified.uncovered_triggers, "{verified:?}");
}

#[test]
fn a_changed_clip_is_found() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let complete = std::fs::read(journaled.out.path().join(&journaled.run.clips[0].file)).unwrap();
    for part in 0..16 {
        let at = complete.len() / 16 * part + part;
        let mut bytes = complete.clone();
        bytes[at] ^= 0x20;
        let changed = journaled.out.write("changed.mcap", &bytes);
        let again = verify_clip(&changed, &root().join(HELLO));
        assert!(
            [2, 4, 7].contains(&again.exit),
            "flip at {at}: exit {} {}",
            again.exit,
            again.stderr
        );
    }
}

#[test]
fn a_clip_without_a_journal_of_the_lambda_is_refused() {
    let journaled = journaled(&root().join(HELLO), &sample_drive(), &BRAKING);
    let clip = journaled.out.path().join(&journaled.run.clips[0].file);
    let again = verify_clip(&clip, &root().join("examples/brake-dark/rust"));
    differs(&again, 2, &["no journal of lambda `brake-dark`", "hello"]);
    differs(
        &verify_clip(&sample_drive(), &root().join(HELLO)),
        2,
        &["no journal of lambda `hello`"],
    );
}
