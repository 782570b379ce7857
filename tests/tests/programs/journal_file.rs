//! The file of `--journal`: only one replay writes it at a time, equal replays write equal bytes,
//! and a kill keeps the decisions.

use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};

use gleaner_journal::{JournalReader, JournalWriter};
use gleaner_lambda::{Clip, Decision};
use gleaner_tests::{LambdaCopy, TempFolder, Verification, replay_to, root, runtime, sample_drive};

const HELLO: &str = "examples/hello/rust";
const BRAKING: [&str; 2] = ["--set", "brake_mps2=-1.4"];

/// Replays hello into `out` with the journal `journal` and further arguments.
fn journaled(out: &TempFolder, journal: &Path, args: &[&str]) -> gleaner_tests::ReplayRun {
    let args = [&BRAKING[..], &["--journal", journal.to_str().unwrap()], args].concat();
    replay_to(out.path(), &root().join(HELLO), &[sample_drive()], &args)
}

fn verify_drive(lambda: &Path, journal: &Path, args: &[&str]) -> Verification {
    super::journal::verify_drive(lambda, &sample_drive(), journal, args)
}

fn hello() -> PathBuf {
    root().join(HELLO)
}

#[test]
fn a_journal_that_another_process_writes_is_refused_and_unchanged() {
    let (first, second) = (TempFolder::new(), TempFolder::new());
    let journal = first.path().join("x.journal");
    journaled(&first, &journal, &[]).must_exit(0);
    let before = std::fs::read(&journal).unwrap();
    let results = journaled(&second, &second.path().join("own.journal"), &[]);
    let lock = std::fs::File::open(&journal).unwrap();
    lock.lock().unwrap();
    for repeat in ["1", "2"] {
        let busy = journaled(&second, &journal, &["--repeat", repeat]);
        busy.must_exit(1);
        let expected =
            format!("another process writes or verifies journal `{}`", journal.display());
        let stderr = &busy.stderr;
        assert!(stderr.contains(&expected) && stderr.contains("--journal FILE"), "{stderr}");
        // The earlier results are complete.
        assert_eq!(
            (busy.decisions.len(), busy.clips.len()),
            (results.decisions.len(), results.clips.len())
        );
    }
    let again = verify_drive(&hello(), &journal, &[]);
    assert_eq!(again.exit, 2, "{}", again.stderr);
    assert!(
        again.stderr.contains("a replay is writing journal") && again.stderr.contains("x.journal"),
        "{}",
        again.stderr
    );
    assert_eq!(std::fs::read(&journal).unwrap(), before);
    lock.unlock().unwrap();
    assert_eq!(verify_drive(&hello(), &journal, &[]).exit, 0);
}

#[test]
fn of_two_replays_with_one_journal_at_least_one_writes_it_completely() {
    let folder = TempFolder::new();
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
            let stderr = String::from_utf8_lossy(&outputs[*index].stderr);
            assert!(stderr.contains("another process writes"), "round {round}: {stderr}");
        }
        // If they ran one after the other, the journal is the later one's.
        let verified = brakes
            .iter()
            .filter(|brake| verify_drive(&hello(), &journal, &["--set", brake]).exit == 0);
        assert_eq!(verified.count(), 1, "round {round}: {refused:?} refused");
    }
}

#[test]
fn equal_replays_write_equal_journals() {
    for kind in ["rust", "python"] {
        let lambda = root().join("examples/hello").join(kind);
        let journals: Vec<_> = (0..3)
            .map(|_| {
                let out = TempFolder::new();
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

/// The journal with a changed header and correct checksums.
fn with_header(
    journal: &Path,
    change: impl FnOnce(&mut gleaner_journal::JournalHeader),
) -> Vec<u8> {
    let bytes = std::fs::read(journal).unwrap();
    let mut reader = JournalReader::open(&bytes[..]).unwrap();
    let mut header = reader.header().clone();
    change(&mut header);
    let mut writer = JournalWriter::begin(Vec::new(), &header).unwrap();
    while let Some(entry) = reader.next().unwrap() {
        writer.wake(&entry).unwrap();
    }
    writer.finish(reader.end().unwrap()).unwrap()
}

#[test]
fn lower_limits_in_a_header_are_noted_and_higher_ones_are_differences() {
    let out = TempFolder::new();
    let journal = out.path().join("x.journal");
    journaled(&out, &journal, &[]).must_exit(0);
    let fuel = |fuel: u64| {
        out.write("forged.journal", with_header(&journal, |header| header.limits.fuel = fuel))
    };
    let complete = verify_drive(&hello(), &fuel(10_000_000), &[]).verified.unwrap();
    assert_eq!(complete.notes, [""; 0]);
    let lower = verify_drive(&hello(), &fuel(9_000_000), &[]);
    let notes = lower.verified.unwrap_or_else(|| panic!("{}", lower.stderr)).notes;
    assert!(
        matches!(&notes[..], [note] if note.contains("limit `fuel`: 9000000 in the journal")),
        "{notes:?}"
    );
    // Limits that cannot have applied: each wake is repeated under them.
    let too_low = verify_drive(&hello(), &fuel(1000), &[]);
    let higher = verify_drive(&hello(), &fuel(10_000_001), &[]);
    for (forged, word) in [(too_low, "fuel"), (higher, "limit `fuel`")] {
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
fn a_journal_that_begins_in_the_middle_is_refused() {
    let out = TempFolder::new();
    let journal = out.path().join("x.journal");
    journaled(&out, &journal, &[]).must_exit(0);
    let forged =
        out.write("forged.journal", with_header(&journal, |header| header.wakes_before = 7));
    let again = verify_drive(&hello(), &forged, &[]);
    assert_eq!(again.exit, 4, "{}", again.stderr);
    let stderr = &again.stderr;
    assert!(stderr.contains("wakes before the first one") && stderr.contains('7'), "{stderr}");
}

/// Kills a replay after it has listed a clip.
#[test]
fn moments_of_listed_clips_are_in_decisions_and_journal_after_a_kill() {
    let lambda = LambdaCopy::of("tests/lambdas/alarm/rust", |manifest| {
        manifest
            .replace("preroll = \"5s\"", "preroll = \"100ms\"")
            .replace("postroll = \"5s\"", "postroll = \"100ms\"")
    });
    let mut hits = 0;
    for attempt in 0..20 {
        let out = TempFolder::new();
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
        let mut reader = JournalReader::open(std::fs::File::open(&journal).unwrap()).unwrap();
        let mut wakes = Vec::new();
        while let Some(entry) = reader.next().unwrap() {
            wakes.push(entry.at_ns);
        }
        for moment in clips.iter().flat_map(|clip| &clip.moments) {
            let at_ns = moment.at_ns;
            let is_decided = decisions.iter().any(|decision| decision.at_ns == at_ns);
            assert!(is_decided, "attempt {attempt}: no decision at {at_ns} ns");
            assert!(wakes.contains(&at_ns), "attempt {attempt}: no wake at {at_ns} ns");
        }
        hits += usize::from(!clips.is_empty() && clips.len() < events.len());
    }
    assert!(hits > 0, "no kill hit a replay that had listed a clip");
}

/// The complete lines of a result file.
fn lines<T: serde::de::DeserializeOwned>(out: &Path, name: &str) -> Vec<T> {
    let text = std::fs::read_to_string(out.join(name)).unwrap_or_default();
    let complete = text.rfind('\n').map_or("", |end| &text[..end]);
    complete.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_journal_is_not_written_into_a_file_of_the_results() {
    let folder = TempFolder::new();
    for name in ["clips.jsonl", "decisions.jsonl", "summary.json"] {
        let journal = folder.path().join(name);
        let args = ["--journal", journal.to_str().unwrap()];
        let run = replay_to(folder.path(), &root().join(HELLO), &[sample_drive()], &args);
        run.must_exit(2);
        assert!(run.stderr.contains("is a file of the results"), "{}", run.stderr);
    }
}

#[test]
fn a_truncated_journal_or_one_of_another_version_is_replaced() {
    let out = TempFolder::new();
    let written = out.path().join("x.journal");
    journaled(&out, &written, &[]).must_exit(0);
    let complete = std::fs::read(&written).unwrap();
    let mut newer = complete.clone();
    newer[8] = 99;
    for found in [&newer[..], &complete[..20], &complete[..complete.len() - 1], b""] {
        let journal = out.write("again.journal", found);
        journaled(&out, &journal, &[]).must_exit(0);
        let again = verify_drive(&hello(), &journal, &[]);
        let verified = again.verified.unwrap_or_else(|| panic!("{}", again.stderr));
        assert!(!verified.truncated, "{verified:?}");
    }
}

#[test]
fn a_journal_is_not_written_over_a_drive() {
    let folder = TempFolder::new();
    let drive = folder.write("drive.mcap", std::fs::read(sample_drive()).unwrap());
    let run = replay_to(
        folder.path(),
        &root().join(HELLO),
        &[sample_drive()],
        &["--journal", drive.to_str().unwrap()],
    );
    run.must_exit(2);
    assert!(run.stderr.contains("is not a journal"), "{}", run.stderr);
    assert_eq!(std::fs::read(drive).unwrap(), std::fs::read(sample_drive()).unwrap());
}
