use gleaner_journal::TimeRange;
use gleaner_lambda::{Recovered, TriggerKind};

use super::*;

const START_NS: i64 = 1_700_000_000_000_000_000;
const PLAIN: Paint = Paint { on: false };

fn replay() -> ReplaySummary {
    ReplaySummary {
        lambda: "brake-dark".to_owned(),
        version: "0.1.0".to_owned(),
        drive: vec!["a.mcap".into()],
        out: "out/demo".into(),
        wakes: 1200,
        triggers: 1,
        start_ns: START_NS,
        end_ns: START_NS + 40_000_000_000,
        wall_s: 0.5,
        run_s: 0.4,
        decode_s: 0.1,
        wakes_per_s: 2400.4,
        peak_rss_bytes: 12 << 20,
        models: vec!["model `det`: rten 0.24".to_owned()],
        topics: vec![TopicReport {
            name: "imu".to_owned(),
            topic: "/imu/data".to_owned(),
            type_name: "sensor_msgs/msg/Imu".to_owned(),
            received: 1200,
            overwritten: 700,
            ..TopicReport::default()
        }],
        ..ReplaySummary::default()
    }
}

fn decision(milliseconds: i64, label: Option<&str>, fault: Option<(FaultKind, &str)>) -> Decision {
    let trigger = |label: &str| Trigger {
        kind: TriggerKind::Event,
        label: label.to_owned(),
        score: Some(1.4567),
        attributes: serde_json::Map::new(),
    };
    Decision {
        at_ns: START_NS + milliseconds * 1_000_000,
        triggers: label.map(trigger).into_iter().collect(),
        fault: fault.map(|(kind, message)| Fault {
            kind,
            message: message.to_owned(),
            used: None,
            allowed: None,
        }),
        ..Decision::default()
    }
}

fn digest(decisions: Vec<Decision>) -> Digest {
    Digest::of(decisions.into_iter().map(Ok), START_NS).unwrap()
}

#[test]
fn a_summary_has_triggers_with_times_speed_and_files() {
    let digest =
        digest(vec![decision(10_810, Some("brake-dark"), None), decision(11_000, None, None)]);
    assert_eq!(
        summary(&replay(), &digest, &[], PLAIN),
        "brake-dark 0.1.0 (wasm): 1 trigger in 1,200 wakes, 40.0 s of drive\n    \
            10.810 s  brake-dark  1.46\n  model `det`: rten 0.24\n  \
          2,400 wakes/s (80x real time), total run time 0.400 s (25 % decoding), peak memory 12.0 MiB\n  \
          out/demo: decisions.jsonl, log.jsonl, summary.json\n"
    );
}

#[test]
fn of_many_triggers_twenty_are_shown_and_the_others_counted() {
    let digest = digest((0..1500).map(|n| decision(1000 * n, Some("x"), None)).collect());
    let text = summary(&ReplaySummary { triggers: 1500, ..replay() }, &digest, &[], PLAIN);
    assert_eq!(text.matches(" s  x  1.46\n").count(), 20);
    assert!(text.contains("              and 1,480 more\n"), "{text}");
}

#[test]
fn triggers_of_one_label_less_than_a_second_apart_are_one_line() {
    let mut decisions: Vec<_> = (0..1500).map(|n| decision(4000 + n, Some("dip"), None)).collect();
    decisions[7].triggers[0].score = Some(2.0);
    decisions[8].triggers[0].score = None;
    decisions.push(decision(5600, Some("brake"), None));
    decisions.push(decision(5700, Some("dip"), None));
    decisions.push(decision(6700, Some("dip"), None));
    let mut twice = decision(9000, Some("turn"), None);
    twice.triggers[0].score = None;
    twice.triggers.extend_from_within(..);
    decisions.push(twice);
    let text =
        summary(&ReplaySummary { triggers: 1505, ..replay() }, &digest(decisions), &[], PLAIN);
    let lines: Vec<_> = text.lines().skip(1).take(5).collect();
    assert_eq!(
        lines,
        [
            "     4.000 to 5.499 s  dip  1,500x, max 2",
            "     5.600 s  brake  1.46",
            "     5.700 s  dip  1.46",
            "     6.700 s  dip  1.46",
            "     9.000 s  turn  2x",
        ]
    );
    assert!(!text.contains("more"), "{text}");
}

#[test]
fn a_part_of_a_drive_is_shown_with_its_times_and_length() {
    let part = TimeRange { from_ns: Some(START_NS + 10_500_000_000), to_ns: None };
    let text = summary(&ReplaySummary { part, ..replay() }, &digest(Vec::new()), &[], PLAIN);
    assert!(text.contains(", 29.5 s of drive"), "{text}");
    assert!(text.contains("  part of the drive: from 10.500 s to 40.000 s\n"), "{text}");
}

#[test]
fn location_and_message_of_a_panic_are_shown() {
    let message =
        "panicked at src/lib.rs:17:9: ouch\nerror while executing at wasm backtrace:\n    0: 0x1";
    let text = summary(
        &ReplaySummary { faults: 1, ..replay() },
        &digest(vec![decision(0, None, Some((FaultKind::Trap, message)))]),
        &[],
        PLAIN,
    );
    assert!(text.contains("1x trap: panicked at src/lib.rs:17:9: ouch\n"), "{text}");
}

#[test]
fn faults_are_grouped_by_their_most_informative_line() {
    let traceback =
        "Traceback (most recent call last):\n  File \"main.py\", line 3\nValueError: no\n";
    let faults =
        [(500, FaultKind::Trap, "a.rs:1:2: no 7\nat f"), (600, FaultKind::Exception, traceback)];
    let mut decisions: Vec<_> =
        faults.map(|(at, kind, message)| decision(at, None, Some((kind, message)))).into();
    decisions.push(decision(700, None, Some((FaultKind::Trap, "a.rs:1:2: no 18\nat g"))));
    let text = summary(&ReplaySummary { faults: 3, ..replay() }, &digest(decisions), &[], PLAIN);
    assert!(
        text.contains("  3 faults\n     0.500 s  2x trap: a.rs:1:2: no 7\n     0.600 s  1x exception: ValueError: no\n"),
        "{text}"
    );
}

#[test]
fn faults_with_many_messages_are_bounded() {
    let message = |n: i64| "m".repeat(n as usize);
    let digest = digest(
        (0..50).map(|n| decision(n, None, Some((FaultKind::HostCall, &message(n))))).collect(),
    );
    assert_eq!((digest.fault_groups.len(), digest.other_faults), (20, 30));
}

#[test]
fn a_long_message_of_a_fault_is_cut() {
    let long = format!("{}{}", "\u{0}".repeat(4), "m".repeat(4000));
    let fault = decision(500, None, Some((FaultKind::Exception, &long)));
    let text = summary(&ReplaySummary { faults: 1, ..replay() }, &digest(vec![fault]), &[], PLAIN);
    let line = text.lines().find(|line| line.contains("exception")).unwrap();
    assert!(
        line.contains("\\u{0}\\u{0}") && line.ends_with("m … (complete in decisions.jsonl)"),
        "{line}"
    );
    assert!(line.chars().count() < 300, "{line}");
}

#[test]
fn losses_have_causes_and_overwritten_samples_are_no_loss() {
    assert!(losses(&replay()).is_empty());
    let mut lossy = ReplaySummary {
        skipped: 1,
        log_dropped: 3000,
        triggers_refused: 1,
        backed_off: 2,
        ..replay()
    };
    lossy.topics[0].lost = Some(2);
    lossy.topics[0].too_big = 4;
    assert_eq!(
        losses(&lossy),
        [
            "2 samples of /imu/data, upstream",
            "4 samples of /imu/data, larger than `max_size`",
            "1 event sample, skipped",
            "3,000 log lines, over the rate limit",
            "1 trigger, refused: over `events_per_minute`",
            "2 wakes, skipped: backing off after repeated faults",
        ]
    );
}

#[test]
fn messages_out_of_order_are_reported_and_are_no_loss() {
    let disordered = ReplaySummary { out_of_order: 2, ..replay() };
    let text = summary(&disordered, &digest(Vec::new()), &[], PLAIN);
    assert!(
        text.contains("\n  out of order: 2 messages came after one with a later log time\n"),
        "{text}"
    );
    assert!(losses(&disordered).is_empty());
    assert!(!summary(&replay(), &digest(Vec::new()), &[], PLAIN).contains("order"));
}

#[test]
fn control_characters_of_a_lambda_are_escaped() {
    let fault = Some((FaultKind::Trap, "\u{1b}[2J"));
    let digest = digest(vec![decision(0, Some("a\u{1b}[2J\nb"), fault)]);
    let damaged = Some("error: \u{7}\n  cause: x".to_owned());
    let text = summary(&ReplaySummary { faults: 1, damaged, ..replay() }, &digest, &[], PLAIN);
    assert!(!text.contains('\u{1b}') && !text.contains('\u{7}'), "{text}");
    assert!(text.contains("    error: \\u{7}\n      cause: x\n"), "{text}");
}

#[test]
fn colours_are_used_only_if_enabled() {
    assert_eq!(Paint { on: true }.red("x"), "\u{1b}[31mx\u{1b}[0m");
    assert_eq!(PLAIN.red("x"), "x");
    assert!(!Paint::new(false).on);
    let colours = Paint { on: true };
    let own = format!("{}\t{}\n", colours.bold("x"), colours.yellow("y"));
    assert_eq!(colours.escaped(&own), own);
    let hostile = "\u{1b}[1mx\u{1b}[2J\r\u{9b}\u{202e}";
    assert_eq!(colours.escaped(hostile), "\u{1b}[1mx\\u{1b}[2J\\r\\u{9b}\\u{202e}");
    assert!(PLAIN.escaped(hostile).is_ascii() && !PLAIN.escaped(hostile).contains('\u{1b}'));
}

/// Returns a clip from 5.8 to 9.0 s of a window up to 15.8 s.
fn clip() -> Clip {
    let at = |seconds: f64| START_NS + (seconds * 1e9) as i64;
    let line = format!(
        r#"{{"file":"clips/x.mcap","thumbnail":"clips/x.jpg","bytes":1048576,"from_ns":{},"to_ns":{},"first_ns":{},
        "last_ns":{},"lambdas":[],"triggers":1,"moments":[],"topics":[{{"topic":"/imu/data","type_name":null,"messages":1646,
        "received":1650,"lost":2,"overwritten":3,"too_big":1}}],"incomplete":["the drive ended 6.8 s before the window did"],
        "recovered":null}}"#,
        at(5.8),
        at(15.8),
        at(5.801),
        at(9.0),
    );
    serde_json::from_str(&line).unwrap()
}

#[test]
fn a_clip_is_shown_with_its_length_topics_thumbnail_and_what_is_missing() {
    let text = summary(
        &ReplaySummary {
            recording: RecordingCounts { clips: 1, ..RecordingCounts::default() },
            ..replay()
        },
        &digest(Vec::new()),
        &[clip()],
        PLAIN,
    );
    let shown = "  1 clip\n     \
                    5.801 to 9.000 s  clips/x.mcap\n              \
                    3.2 s, 1.0 MiB: messages /imu/data 1,646; clips/x.jpg\n              \
                    incomplete: the drive ended 6.8 s before the window did\n              \
                    lost: 2 messages of /imu/data, upstream\n";
    assert!(text.contains(shown), "{text}");
    assert!(
        text.ends_with("out/demo: decisions.jsonl, log.jsonl, summary.json, clips.jsonl, clips/\n"),
        "{text}"
    );
}

#[test]
fn starts_and_stops_are_named_and_triggers_without_a_clip_are_counted() {
    let mut decisions =
        vec![decision(1000, Some("turn"), None), decision(1100, Some("turn"), None)];
    decisions[0].triggers[0].kind = TriggerKind::Start;
    decisions[1].triggers[0].kind = TriggerKind::Stop;
    let recording = RecordingCounts {
        in_cooldown: 2,
        ignored: 1,
        evicted_early: 3,
        ..RecordingCounts::default()
    };
    let quiet = ReplaySummary { recording, clips_replaced: 5, ..replay() };
    let text = summary(&quiet, &digest(decisions), &[], PLAIN);
    for line in [
        "  turn, start  1.46\n",
        "  turn, stop  1.46\n",
        "  no window: 2 triggers, within the cooldown of another\n",
        "  no window: 1 start or stop, of a recording that was already running, or not running\n",
        "  lost: 3 samples, evicted from the preroll too early: preroll_size\n",
        "  replaced: 5 clips of an earlier replay\n",
    ] {
        assert!(text.contains(line), "no `{line}` in {text}");
    }
}

#[test]
fn a_recovered_clip_shows_the_lost_bytes() {
    let recovered = Some(Recovered { lost_bytes: 1200, note: "the recorder died".to_owned() });
    let text = summary(&replay(), &digest(Vec::new()), &[Clip { recovered, ..clip() }], PLAIN);
    assert!(text.contains("recovered: the recorder died (1,200 bytes lost)\n"), "{text}");
}

#[test]
fn a_verified_journal_shows_compared_and_uncovered_decisions() {
    let mut result = Verified {
        lambda: "hello".to_owned(),
        wakes: 4170,
        triggers: 3,
        uncovered: 0,
        uncovered_triggers: 0,
        truncated: false,
        wall_s: 0.25,
        notes: Vec::new(),
    };
    assert_eq!(
        verified(&result, PLAIN),
        "hello: 4,170 decisions with 3 triggers repeated, all identical\n  0.250 s\n"
    );
    (result.uncovered, result.uncovered_triggers) = (50, 1);
    result.truncated = true;
    result.notes = vec!["machine: aarch64 in the journal, x86_64 now".to_owned()];
    let text = verified(&result, PLAIN);
    assert!(
        text.starts_with(
            "hello: 4,120 decisions with 2 triggers repeated, all identical\n  50 wakes with 1"
        ),
        "{text}"
    );
    assert!(
        text.contains("the journal is truncated") && text.contains("machine: aarch64"),
        "{text}"
    );
}
