//! Tests comparisons: the most significant difference is reported.

use super::*;

#[track_caller]
fn assert_differs(difference: Option<Difference>, what: &str, journal: &str, now: &str) {
    let sides =
        Difference { what: what.to_owned(), journal: journal.to_owned(), now: now.to_owned() };
    assert_eq!(difference, Some(sides));
}

fn with(change: impl FnOnce(&mut JournalHeader)) -> Option<Difference> {
    let mut now = header(2);
    change(&mut now);
    header(2).differs_from(&now)
}

#[test]
fn facts_that_decisions_do_not_depend_on_are_not_compared() {
    let difference = with(|now| {
        now.gleaner = "9".to_owned();
        now.engine = "Python".to_owned();
        now.machine = "aarch64".to_owned();
        now.wakes_before = 3;
        now.files.reverse();
    });
    assert_eq!(difference, None);
}

#[test]
fn the_most_significant_difference_of_a_header_comes_first() {
    type Case = (fn(&mut JournalHeader), [&'static str; 3]);
    let changes: [Case; 10] = [
        (|now| now.clock = "system".to_owned(), ["clock", "log time of the drive", "system"]),
        (|now| now.remaps.clear(), ["remapped topics", "/in0 is /wire0", "none"]),
        (
            |now| now.event_input = None,
            ["schedule of the lambda", "samples of input `in0`", "the clock"],
        ),
        (
            |now| now.inputs[1].wire_topic = "/in1".to_owned(),
            [
                "input",
                "`in1`: /in1, from /wire1, sensor_msgs/msg/Imu",
                "`in1`: /in1, sensor_msgs/msg/Imu",
            ],
        ),
        (|now| now.config["brake_mps2"] = json!(-3), ["config `brake_mps2`", "-3.0", "-3"]),
        (
            |now| now.models.clear(),
            ["model `models/d.onnx`", "sha256 0123456789abcdef…", "missing"],
        ),
        (|now| now.limits.deadline /= 2, ["limit `deadline`", "50ms", "25ms"]),
        (
            |now| now.manifest = "0a".to_owned(),
            ["manifest lambda.toml, less [record] and [limits]", "", "0a"],
        ),
        (
            |now| now.files[0].sha256 = "f".repeat(64),
            [
                "build file `brake_dark.wasm`",
                "sha256 0123456789abcdef…",
                "sha256 ffffffffffffffff…",
            ],
        ),
        (|now| now.version = "0.2.0".to_owned(), ["version of the lambda", "0.1.0", "0.2.0"]),
    ];
    let mut now = header(2);
    for (change, [what, journal, now_text]) in changes {
        change(&mut now);
        assert_differs(header(2).differs_from(&now), what, journal, now_text);
    }
}

#[test]
fn files_and_config_that_only_one_side_has_are_differences() {
    let (wasm, begin) = ("build file `brake_dark.wasm`", "sha256 0123456789abcdef…");
    assert_differs(with(|now| now.files.remove(0).path.clear()), wasm, begin, "missing");
    // Only the relevant parts of the manifest are compared.
    assert_eq!(with(|now| now.files.remove(1).path.clear()), None);
    let more = FileDigest { path: "a.py".to_owned(), bytes: 1, sha256: "ab".repeat(32) };
    let digest = "sha256 abababababababab…";
    assert_differs(with(|now| now.files.push(more)), "build file `a.py`", "missing", digest);
    let more = || ("new".to_owned(), json!(true));
    assert_differs(with(|now| now.config.extend([more()])), "config `new`", "missing", "true");
    assert_differs(with(|now| now.inputs.truncate(1)), "number of inputs", "2", "1");
}

#[test]
fn digests_with_the_same_start_are_shown_completely() {
    let (file, begin) = ("build file `brake_dark.wasm`", "0123456789abcdef");
    let other = format!("{begin}{}", "0".repeat(48));
    let (journal, now) = (format!("sha256 {}", begin.repeat(4)), format!("sha256 {other}"));
    assert_differs(with(|header| header.files[0].sha256 = other), file, &journal, &now);
    // A digest in a journal may be any text.
    let difference = with(|header| header.files[0].sha256 = "ä".to_owned());
    assert_differs(difference, file, "sha256 0123456789abcdef…", "sha256 ä");
}

fn entry() -> JournalEntry {
    JournalEntry {
        at_ns: 10,
        cause: WakeSource::Sample { writer: [0xab; 16], seq: (1 << 32) + 7 },
        seen: vec![
            InputView { new: 1, digest: 0x1a, newest: Some(([0xab; 16], 7)), reach: 2 },
            InputView::default(),
        ],
        triggers: vec![Trigger {
            kind: TriggerKind::Event,
            label: "brake".to_owned(),
            score: Some(0.0),
            attributes: Map::from_iter([("a".to_owned(), json!(0.5)), ("b".to_owned(), json!(1))]),
        }],
        fault: None,
        fuel: Some(5),
        log: LogDigest { lines: 1, digest: 2 },
    }
}

fn changed(change: impl FnOnce(&mut JournalEntry)) -> Option<Difference> {
    let mut now = entry();
    change(&mut now);
    entry().differs_from(&now, &header(2).inputs, true)
}

#[test]
fn equal_wakes_do_not_differ() {
    assert_eq!(changed(|_| ()), None);
    let plain = JournalEntry { triggers: Vec::new(), ..entry() };
    assert_eq!(plain.differs_from(&plain.clone(), &[], true), None);
}

#[test]
fn causes_are_compared_including_the_writer() {
    assert_differs(changed(|now| now.at_ns = 11), "stamp of the wake, in ns", "10", "11");
    let writer = "ab".repeat(16);
    let sample = |seq: u64| format!("sample {seq} of writer {writer}");
    let tick = |missed| WakeSource::Tick { missed };
    let next = WakeSource::Sample { writer: [0xab; 16], seq: (1 << 32) + 8 };
    for (cause, describe) in [
        (tick(0), "a tick"),
        (tick(3), "a tick after 3 missed ones"),
        (next, &sample(4_294_967_304)),
    ] {
        let difference = changed(|now| now.cause = cause);
        assert_differs(difference, "cause of the wake", &sample(4_294_967_303), describe);
    }
}

#[test]
fn samples_of_a_clip_are_compared_as_far_as_a_clip_keeps_them() {
    let mut now = entry();
    now.cause = WakeSource::Sample { writer: [1; 16], seq: 7 };
    now.seen[0].newest = Some(([1; 16], 7 + (5 << 32)));
    assert_eq!(entry().differs_from(&now, &[], false), None);
    assert!(entry().differs_from(&now, &[], true).is_some());
    now.cause = WakeSource::Sample { writer: [1; 16], seq: 8 };
    let difference = entry().differs_from(&now, &[], false);
    assert_differs(difference, "cause of the wake", "sample 7", "sample 8");
}

#[test]
fn differences_of_samples_name_the_input() {
    let what = "number of new samples of input `in0` (/wire0)";
    assert_differs(changed(|now| now.seen[0].new = 2), what, "1", "2");
    let newest = format!("7 of writer {}", "ab".repeat(16));
    let what = "newest sample of input `in0` (/wire0)";
    assert_differs(changed(|now| now.seen[0].newest = None), what, &newest, "none");
    let difference = changed(|now| now.seen[0].digest = 0x1b);
    let what = "samples of input `in0` (/wire0)";
    assert_differs(difference, what, "digest 0000001a", "digest 0000001b");
    let what = "number of samples of input `in1` (/wire1) that the lambda looked back";
    assert_differs(changed(|now| now.seen[1].reach = 9), what, "0", "9");
    assert_differs(changed(|now| now.seen.truncate(1)), "number of inputs", "2", "1");
    let mut now = entry();
    now.seen[1].new = 1;
    let difference = entry().differs_from(&now, &[], true);
    assert_differs(difference, "number of new samples of input 2", "0", "1");
}

#[test]
fn triggers_are_compared_bit_for_bit() {
    assert_differs(changed(|now| now.triggers.clear()), "number of triggers", "1", "0");
    let trigger = |change: fn(&mut Trigger)| changed(|now| change(&mut now.triggers[0]));
    let kind = trigger(|it| it.kind = TriggerKind::Stop);
    assert_differs(kind, "trigger 1: kind", "event", "stop");
    let label = trigger(|it| it.label = "x\u{1b}".to_owned());
    assert_differs(label, "trigger 1: label", "`brake`", "`x\\u{1b}`");
    assert_differs(trigger(|it| it.score = Some(-0.0)), "trigger 1: score", "0", "-0");
    assert_differs(trigger(|it| it.score = None), "trigger 1: score", "0", "none");
    let attribute = |key: &str, value, journal: &str, now: &str| {
        let more = [(key.to_owned(), value)];
        let difference = changed(|now| now.triggers[0].attributes.extend(more));
        assert_differs(difference, &format!("trigger 1: attribute `{key}`"), journal, now);
    };
    attribute("a", json!(0.500_000_000_000_000_1), "0.5", "0.5000000000000001");
    attribute("b", json!(1.0), "1", "1.0");
    attribute("c", json!("x"), "none", "\"x\"");
    let order = trigger(|it| {
        let first = it.attributes.shift_remove("a").unwrap();
        it.attributes.insert("a".to_owned(), first);
    });
    assert_differs(order, "trigger 1: order of its attributes", "a, b", "b, a");
}

#[test]
fn faults_fuel_and_logs_are_compared() {
    let fault = Fault {
        kind: gleaner_lambda::FaultKind::HostCall,
        message: "no\n".to_owned(),
        used: None,
        allowed: Some(8),
    };
    let now = "host_call, `no\\n`, used none, allowed 8";
    assert_differs(changed(|now| now.fault = Some(fault)), "fault", "none", now);
    assert_differs(changed(|now| now.fuel = Some(6)), "fuel", "5", "6");
    assert_differs(changed(|now| now.fuel = None), "fuel", "5", "none");
    assert_differs(changed(|now| now.log.lines = 2), "number of log lines", "1", "2");
    let text = changed(|now| now.log.digest = 3);
    assert_differs(text, "text of the log lines", "digest 00000002", "digest 00000003");
}

#[test]
fn every_kind_of_fault_has_its_code_and_its_word_in_decisions() {
    for (place, (kind, word)) in FAULTS.iter().enumerate() {
        assert_eq!(fault_code(*kind), place);
        assert_eq!(serde_json::to_value(kind).unwrap(), json!(word));
    }
}
