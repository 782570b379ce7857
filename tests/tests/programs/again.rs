//! Repeated replays and verifications make the same decisions, to the last bit. `GLEANER_AGAIN`
//! sets the number of repetitions.

use std::collections::HashSet;
use std::path::Path;

use gleaner_journal::{JournalEntry, JournalReader};
use gleaner_tests::{TempFolder, replay_to, root, sample_drive, times, verify};
use serde_json::Value;

/// Results of a replay, without durations.
#[derive(PartialEq)]
struct TimelessResults {
    /// Lines of `decisions.jsonl`, with the fuel of each wake.
    decisions: Vec<String>,
    log: String,
    journal: Vec<JournalEntry>,
}

fn results(folder: &Path) -> TimelessResults {
    let read = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
    let timeless = |line: &str| {
        let mut decision: serde_json::Map<String, Value> = serde_json::from_str(line).unwrap();
        assert!(decision.remove("run_ns").is_some() && decision.contains_key("fuel"), "{line}");
        Value::Object(decision).to_string()
    };
    let journal = std::fs::read(folder.join("wakes.journal")).unwrap();
    let mut journal = JournalReader::open(journal.as_slice()).unwrap();
    let entries = std::iter::from_fn(|| journal.next().unwrap()).collect();
    TimelessResults {
        decisions: read("decisions.jsonl").lines().map(timeless).collect(),
        log: read("log.jsonl"),
        journal: entries,
    }
}

#[test]
fn a_lambda_that_faults_now_and_then_decides_the_same_bits_each_time() {
    let (lambda, folder) = (root().join("tests/lambdas/misbehave/rust"), TempFolder::new());
    let first = folder.path().join("first/wakes.journal");
    let replayed = |name: &str| {
        let out = folder.path().join(name);
        std::fs::create_dir_all(&out).unwrap();
        let journal = out.join("wakes.journal");
        let args =
            ["--set", "behaviour=now_and_then", "--all", "--journal", journal.to_str().unwrap()];
        let run = replay_to(&out, &lambda, &[sample_drive()], &args);
        (results(&out), run)
    };
    let (expected, run) = replayed("first");
    let kinds: HashSet<_> =
        run.decisions.iter().filter_map(|decision| Some(decision.fault.as_ref()?.kind)).collect();
    assert!(kinds.len() >= 6, "only faults of {kinds:?}");
    assert!(run.decisions.iter().any(|decision| !decision.triggers.is_empty()));
    assert_eq!(
        (expected.decisions.len(), expected.journal.len()),
        (run.decisions.len(), run.decisions.len())
    );
    for time in 1..=times("GLEANER_AGAIN", 3) {
        let (now, _) = replayed("again");
        let line =
            expected.decisions.iter().zip(&now.decisions).position(|(before, now)| before != now);
        assert_eq!(line, None, "time {time}: this decision differs");
        assert!(now == expected, "time {time}: the log or the journal differs");
        let again = verify(&[
            "replay".as_ref(),
            lambda.as_ref(),
            sample_drive().as_ref(),
            "--verify".as_ref(),
            first.as_ref(),
        ]);
        let verified = again.verified.unwrap_or_else(|| panic!("time {time}: {}", again.stderr));
        assert_eq!(
            (verified.wakes, verified.uncovered),
            (run.decisions.len() as u64, 0),
            "time {time}"
        );
    }
}
