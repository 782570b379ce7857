//! A drive played live is decided as in its replay, and its clips are verified.
//!
//! `GLEANER_ROUNDS` sets how often it is played; the default is once.

use std::collections::BTreeSet;
use std::path::Path;

use gleaner_protocol::{LiveStatus, LiveTopic, Report};
use gleaner_tests::live::{decisions, play, run_all};
use gleaner_tests::{LambdaCopy, TempFolder, replay_to, sample_drive, times, verify_clip};

use super::{TriggerKey, clips, trigger_keys};

/// Returns whether the labels are the same, for the same camera samples and nearly the same IMU
/// samples.
///
/// Both lambdas use half a second of the IMU by receive stamps. Live, these jitter by a millisecond
/// and more, so that a sample at the edge is in or out; a threshold may then be crossed some
/// samples earlier or later. A frame of the camera is 10 of them. Skipped samples add as many.
fn agrees(live: &[TriggerKey], replay: &[TriggerKey], skipped: u64) -> bool {
    let is_camera = replay.iter().all(|(label, _)| label == "brake-dark");
    let slack = skipped + if is_camera { 0 } else { 10 };
    let same = |((a, n), (b, m)): (&TriggerKey, &TriggerKey)| {
        a == b && n.zip(*m).is_some_and(|(n, m)| n.abs_diff(m) <= slack)
    };
    live.len() == replay.len() && live.iter().zip(replay).all(same)
}

fn lost(ended: &LiveStatus) -> u64 {
    ended
        .topics
        .iter()
        .map(|topic| topic.lost.expect("DDS counts losses") + topic.no_slot + topic.malformed)
        .sum()
}

/// A busy machine may stall for longer than the jitter of a window. Drives with differences are
/// played again; differences that repeat are failures.
pub fn as_in_replay() {
    /// Maximum attempts until a lambda decides as in its replay.
    const TRIES: usize = 6;
    let lambdas = TWINS.map(|(of, name)| LambdaCopy::named(of, name));
    let drive = sample_drive();
    let replayed = |lambda: &LambdaCopy| {
        let (out, set) = (TempFolder::new(), ["--set", "brake_mps2=-1.4"]);
        let replayed = replay_to(out.path(), lambda.path(), std::slice::from_ref(&drive), &set);
        let expected = trigger_keys(&replayed.decisions);
        assert!(!expected.is_empty(), "{}", replayed.stderr);
        expected
    };
    let expected = lambdas.each_ref().map(replayed);
    let mut totals = [0; 3];
    for round in 1..=times("GLEANER_ROUNDS", 1) {
        let mut failing = TWINS.map(|(_, name)| name).to_vec();
        let mut differences = Vec::new();
        for _ in 0..TRIES {
            totals[0] += 1;
            let found = played(&drive, &lambdas, &expected, &mut totals);
            for ((_, name), found) in TWINS.into_iter().zip(found) {
                match found {
                    Some(difference) => differences.push(format!("{name}: {difference}")),
                    None => failing.retain(|other| *other != name),
                }
            }
            if failing.is_empty() {
                break;
            }
        }
        println!("round {round}: {} differences {differences:#?}", differences.len());
        assert!(
            failing.is_empty(),
            "round {round}: different from the replay in {TRIES} attempts: {differences:#?}"
        );
    }
    let [runs, clips, wakes] = totals;
    println!("{runs} runs; {clips} clips verified, {wakes} wakes compared");
}

/// The twins that share a run, with their names in it.
const TWINS: [(&str, &str); 4] = [
    ("examples/hello/rust", "hello-rust"),
    ("examples/hello/python", "hello-python"),
    ("examples/brake-dark/rust", "dark-rust"),
    ("examples/brake-dark/python", "dark-python"),
];

/// Plays the drive to these lambdas together, and verifies the clips. Returns for each lambda how
/// its decisions differ from the replay. Adds clips and compared wakes to `totals`.
fn played(
    drive: &Path,
    lambdas: &[LambdaCopy; 4],
    expected: &[Vec<TriggerKey>; 4],
    totals: &mut [u64; 3],
) -> Vec<Option<String>> {
    let out = TempFolder::new();
    let settings = TWINS.map(|(_, name)| format!("{name}.brake_mps2=-1.4"));
    let args: Vec<&str> = settings.iter().flat_map(|setting| ["--set", setting]).collect();
    let folders = lambdas.each_ref().map(LambdaCopy::path);
    let started = run_all(&folders, out.path(), &args);
    started.until_all_ready(TWINS.len());
    let path = drive.to_str().expect("the checkout has a plain path");
    let played = play(&[path, "--wait", "1"]).finish();
    assert!(played.status.success(), "{}", played.stderr);
    // The last sample may be in transit, and windows are open for some seconds after it.
    let mut over = BTreeSet::new();
    started.until_named("the end of the drive", |name, report| {
        if let Report::Live(live) = report {
            let is_over =
                live.topics.iter().all(|topic| topic.writers == Some(0) && topic.received > 0);
            // Each sample of the event input was handled: one of the topics causes the wakes.
            let is_handled = |topic: &LiveTopic| live.wakes + topic.skipped == topic.received;
            if is_over && live.topics.iter().any(is_handled) {
                over.insert(name);
            }
        }
        (over.len() == TWINS.len()).then_some(())
    });
    let finished = started.interrupt();
    assert!(finished.status.success(), "{}, {}", finished.status, finished.stderr);
    for clip in clips(out.path()) {
        let file = out.path().join(&clip.file);
        let of = TWINS.iter().zip(lambdas);
        for (_, lambda) in
            of.filter(|((_, name), _)| clip.lambdas.iter().any(|it| it.name == *name))
        {
            let again = verify_clip(&file, lambda.path());
            let verified = again.verified.unwrap_or_else(|| panic!("{}: {clip:#?}", again.stderr));
            totals[2] += verified.wakes - verified.uncovered;
        }
        totals[1] += 1;
    }
    let compared = |((_, name), expected): (&(&str, &str), &Vec<TriggerKey>)| {
        let ended = finished.ended_of(name).expect("it has ended");
        assert_eq!(ended.faults, 0, "{}", finished.stderr);
        let live = trigger_keys(&decisions(&out.path().join(name)));
        if lost(&ended) == 0 && agrees(&live, expected, ended.skipped) {
            return None;
        }
        Some(format!(
            "{} skipped, {} lost: {live:?}, in the replay {expected:?}",
            ended.skipped,
            lost(&ended)
        ))
    };
    TWINS.iter().zip(expected).map(compared).collect()
}
