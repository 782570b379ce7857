//! The file of `--journal`: one replay writes it at a time, equal replays write equal bytes, and a
//! kill leaves what was decided.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};

use gleaner_journal::{Reader, Writer};
use gleaner_lambda::{Clip, Decision};
use gleaner_tests::{Copy, Folder, Verification, replay_to, root, runtime, sample_drive, verify};

const HELLO: &str = "examples/hello/rust";
const BRAKING: [&str; 2] = ["--set", "brake_mps2=-1.4"];

/// Replays hello into `out` with the journal `journal`, and more arguments.
fn journaled(out: &Folder, journal: &Path, args: &[&str]) -> gleaner_tests::Run {
    let args = [&BRAKING[..], &["--journal", journal.to_str().unwrap()], args].concat();
    replay_to(out.path(), &root().join(HELLO), &[sample_drive()], &args)
}

fn verify_drive(lambda: &Path, journal: &Path, args: &[&str]) -> Verification {
    let drive = sample_drive();
    let mut line: Vec<&OsStr> =
        vec!["replay".as_ref(), lambda.as_ref(), drive.as_ref(), "--verify".as_ref()];
    line.push(journal.as_ref());
    line.extend(args.iter().map(OsStr::new));
    verify(&line)
}

fn hello() -> PathBuf {
    root().join(HELLO)
}

#[test]
fn a_journal_that_another_process_writes_is_refused_and_left_as_it_is() {
    let (first, second) = (Folder::new(), Folder::new());
    let journal = first.path().join("x.journal");
    journaled(&first, &journal, &[]).must_exit(0);
    let before = std::fs::read(&journal).unwrap();
    let results = journaled(&second, &second.path().join("own.journal"), &[]);
    let lock = std::fs::File::open(&journal).unwrap();
    lock.lock().unwrap();
    for repeat in ["1", "2"] {
        let busy = journaled(&second, &journal, &["--repeat", repeat]);
        busy.must_exit(1);
        let said = format!("another process writes or verifies journal `{}`", journal.display());
        assert!(
            busy.stderr.contains(&said) && busy.stderr.contains("--journal FILE"),
            "{}",
            busy.stderr
        );
        // The results of before are whole.
        assert_eq!(
            (busy.decisions.len(), busy.clips.len()),
            (results.decisions.len(), results.clips.len())
        );
    }
    let again = verify_drive(&hello(), &journal, &[]);
    assert_eq!(again.exit, 2, "{}", again.stderr);
    assert!(
        again.stderr.contains("a replay writes journal") && again.stderr.contains("x.journal"),
        "{}",
        again.stderr
    );
    assert_eq!(std::fs::read(&journal).unwrap(), before);
    lock.unlock().unwrap();
    assert_eq!(verify_drive(&hello(), &journal, &[]).exit, 0);
}

#[test]
fn of_two_replays_with_one_journal_at_least_one_writes_it_whole() {
    let folder = Folder::new();
    let journal = folder.path().join("x.journal");
    for round in 0..8 {
        let _ = std::fs::remove_file(&journal);
        let start = |name: &str, brake: &str| {
            let mut replay = runtime();
            replay
                .arg("replay")
                .arg(hello())
                .arg(sample_drive())
                .args(["--set", brake, "--journal"])
                .arg(&journal);
            replay.arg("--out").arg(folder.path().join(name));
            replay.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
        };
        let brakes = ["brake_mps2=-1.4", "brake_mps2=-1.3"];
        let children: Vec<Child> =
            ["a", "b"].iter().zip(brakes).map(|(name, brake)| start(name, brake)).collect();
        let outputs: Vec<_> =
            children.into_iter().map(|child| child.wait_with_output().unwrap()).collect();
        let ended = |index: usize| outputs[index].status.code();
        let refused: Vec<_> = (0..2).filter(|index| ended(*index) == Some(1)).collect();
        assert!(
            refused.len() < 2 && (0..2).all(|index| matches!(ended(index), Some(0 | 1))),
            "round {round}: {outputs:?}"
        );
        for index in &refused {
            let said = String::from_utf8_lossy(&outputs[*index].stderr);
            assert!(said.contains("another process writes"), "round {round}: {said}");
        }
        // Of two that came one after the other, the later one.
        let proved = brakes
            .iter()
            .filter(|brake| verify_drive(&hello(), &journal, &["--set", brake]).exit == 0);
        assert_eq!(proved.count(), 1, "round {round}: {refused:?} refused");
    }
}

#[test]
fn equal_replays_write_equal_journals() {
    for kind in ["rust", "python"] {
        let lambda = root().join("examples/hello").join(kind);
        let journals: Vec<_> = (0..3)
            .map(|_| {
                let out = Folder::new();
                let journal = out.path().join("x.journal");
                let args = [&BRAKING[..], &["--journal", journal.to_str().unwrap()]].concat();
                replay_to(out.path(), &lambda, &[sample_drive()], &args).must_exit(0);
                std::fs::read(&journal).unwrap()
            })
            .collect();
        assert!(
            journals[0].len() > 10_000 && journals.iter().all(|journal| *journal == journals[0]),
            "{kind}"
        );
    }
}

/// The journal, with its header changed and all checksums right.
fn with_header(journal: &Path, change: impl FnOnce(&mut gleaner_journal::Header)) -> Vec<u8> {
    let bytes = std::fs::read(journal).unwrap();
    let mut reader = Reader::open(&bytes[..]).unwrap();
    let mut header = reader.header().clone();
    change(&mut header);
    let mut writer = Writer::begin(Vec::new(), &header).unwrap();
    while let Some(entry) = reader.next().unwrap() {
        writer.wake(&entry).unwrap();
    }
    writer.finish(reader.end().unwrap()).unwrap()
}

#[test]
fn tighter_limits_in_a_header_are_noted_and_wider_ones_differ() {
    let out = Folder::new();
    let journal = out.path().join("x.journal");
    journaled(&out, &journal, &[]).must_exit(0);
    let fuel = |fuel: u64| {
        out.write("forged.journal", with_header(&journal, |header| header.limits.fuel = fuel))
    };
    let whole = verify_drive(&hello(), &fuel(10_000_000), &[]).verified.unwrap();
    assert_eq!(whole.notes, [""; 0]);
    let tighter = verify_drive(&hello(), &fuel(9_000_000), &[]);
    let notes = tighter.verified.unwrap_or_else(|| panic!("{}", tighter.stderr)).notes;
    assert!(
        matches!(&notes[..], [note] if note.contains("limit `fuel`: 9000000 in the journal")),
        "{notes:?}"
    );
    // Limits that cannot have held: each wake is made again under them.
    let too_tight = verify_drive(&hello(), &fuel(1000), &[]);
    let wider = verify_drive(&hello(), &fuel(10_000_001), &[]);
    for (forged, word) in [(too_tight, "fuel"), (wider, "limit `fuel`")] {
        assert_eq!(forged.exit, 4, "{}", forged.stderr);
        assert!(forged.stderr.contains(word), "{}", forged.stderr);
    }
    let vehicle = out.write("vehicle.toml", "[limits]\nfuel = 9_000_000\n");
    let with_vehicle =
        |journal: &Path| verify_drive(&hello(), journal, &["--vehicle", vehicle.to_str().unwrap()]);
    assert_eq!(with_vehicle(&fuel(9_000_000)).verified.unwrap().notes, [""; 0]);
    assert_eq!(with_vehicle(&fuel(8_000_000)).exit, 4);
}

#[test]
fn a_journal_that_begins_in_the_middle_is_no_journal_of_a_replay() {
    let out = Folder::new();
    let journal = out.path().join("x.journal");
    journaled(&out, &journal, &[]).must_exit(0);
    let forged =
        out.write("forged.journal", with_header(&journal, |header| header.wakes_before = 7));
    let again = verify_drive(&hello(), &forged, &[]);
    assert_eq!(again.exit, 4, "{}", again.stderr);
    assert!(
        again.stderr.contains("wakes before the first one") && again.stderr.contains('7'),
        "{}",
        again.stderr
    );
}

/// Kills a replay when it has listed a clip.
#[test]
fn what_a_listed_clip_is_about_is_in_the_decisions_and_in_the_journal_after_a_kill() {
    let lambda = Copy::of("tests/lambdas/alarm/rust", |manifest| {
        manifest
            .replace("preroll = \"5s\"", "preroll = \"100ms\"")
            .replace("postroll = \"5s\"", "postroll = \"100ms\"")
    });
    let mut met = 0;
    for attempt in 0..20 {
        let out = Folder::new();
        let journal = out.path().join("x.journal");
        let events: Vec<String> = (1..20).map(|second| (2 * second).to_string()).collect();
        let mut replay = runtime();
        replay.arg("replay").arg(lambda.path()).arg(sample_drive()).arg("--out").arg(out.path());
        replay.args(["--set", &format!("event_s={}", events.join(",")), "--journal"]).arg(&journal);
        let mut child = replay.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        // A different number of clips each time.
        let wanted = 1 + attempt % 5;
        while lines::<Clip>(out.path(), "clips.jsonl").len() < wanted
            && child.try_wait().unwrap().is_none()
        {}
        child.kill().unwrap();
        child.wait().unwrap();
        let (clips, decisions) = (
            lines::<Clip>(out.path(), "clips.jsonl"),
            lines::<Decision>(out.path(), "decisions.jsonl"),
        );
        let mut reader = Reader::open(std::fs::File::open(&journal).unwrap()).unwrap();
        let mut wakes = Vec::new();
        while let Some(entry) = reader.next().unwrap() {
            wakes.push(entry.at_ns);
        }
        for moment in clips.iter().flat_map(|clip| &clip.moments) {
            let is_there = decisions.iter().any(|decision| decision.at_ns == moment.at_ns);
            assert!(is_there, "attempt {attempt}: no decision at {} ns", moment.at_ns);
            assert!(
                wakes.contains(&moment.at_ns),
                "attempt {attempt}: no wake at {} ns",
                moment.at_ns
            );
        }
        met += usize::from(!clips.is_empty() && clips.len() < events.len());
    }
    assert!(met > 0, "no kill met a replay that had listed a clip");
}

/// The whole lines of a file of results.
fn lines<T: serde::de::DeserializeOwned>(out: &Path, name: &str) -> Vec<T> {
    let text = std::fs::read_to_string(out.join(name)).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    whole.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_journal_is_not_written_into_a_file_of_the_results() {
    let folder = Folder::new();
    for name in ["clips.jsonl", "decisions.jsonl", "summary.json"] {
        let journal = folder.path().join(name);
        let args = ["--journal", journal.to_str().unwrap()];
        let run = replay_to(folder.path(), &root().join(HELLO), &[sample_drive()], &args);
        run.must_exit(2);
        assert!(run.stderr.contains("is a file of the results"), "{}", run.stderr);
    }
}

#[test]
fn a_journal_of_another_version_or_that_is_cut_off_is_replaced() {
    let out = Folder::new();
    let written = out.path().join("x.journal");
    journaled(&out, &written, &[]).must_exit(0);
    let whole = std::fs::read(&written).unwrap();
    let mut newer = whole.clone();
    newer[8] = 99;
    for found in [&newer[..], &whole[..20], &whole[..whole.len() - 1], b""] {
        let journal = out.write("again.journal", found);
        journaled(&out, &journal, &[]).must_exit(0);
        let again = verify_drive(&hello(), &journal, &[]);
        let verified = again.verified.unwrap_or_else(|| panic!("{}", again.stderr));
        assert!(!verified.truncated, "{verified:?}");
    }
}

#[test]
fn a_journal_is_not_written_over_a_drive() {
    let folder = Folder::new();
    let drive = folder.write("drive.mcap", std::fs::read(sample_drive()).unwrap());
    let run = replay_to(
        folder.path(),
        &root().join(HELLO),
        &[sample_drive()],
        &["--journal", drive.to_str().unwrap()],
    );
    run.must_exit(2);
    assert!(run.stderr.contains("is no journal"), "{}", run.stderr);
    assert_eq!(std::fs::read(drive).unwrap(), std::fs::read(sample_drive()).unwrap());
}
