//! Tests of the page on results that the tests write, valid and hostile.

use std::fs;

use gleaner_protocol::RecordingCounts;
use gleaner_protocol::link::{RecordedTopic, RecorderStatus};
use serde_json::{Value, json};

use gleaner_base::{Exit, Failure};

use super::{ReportPage, collect};
use crate::diff::Diff;
use crate::tests::{Out, START_NS, summary, trigger, wake};

impl Out {
    fn data(&self) -> Value {
        serde_json::to_value(collect::collect(self.path(), 1, None).unwrap()).unwrap()
    }
}

fn signals() -> Value {
    let spread = json!({"count": 400, "min": 1000, "p50": 2000, "p90": 3000, "p99": 4000, "max": 9000,
        "bins": [{"from": 1000, "to": 2000, "count": 150}, {"from": 2000, "to": 9001, "count": 250}]});
    json!({
        "config": {"brake_mps2": -1.4, "name": "x"},
        "curves": [{
            "input": "imu", "topic": "/imu", "path": "linear_acceleration.x", "samples": 4, "non_finite": 1, "per_point": 2,
            "at_ns": [START_NS, START_NS + 500_000_000], "min": [0.123456789123, -1.0], "max": [0.5, 2.0],
        }],
        "curves_omitted": 3, "run_ns": spread, "fuel": spread,
        "pictures": [], "pictures_omitted": 0,
    })
}

const JPEG: &[u8] = &[0xff, 0xd8, 0xff, 0xe0, 1, 2, 3];

fn clip(thumbnail: &str) -> Value {
    json!({
        "file": "clips/a.mcap", "thumbnail": thumbnail, "bytes": 4096, "from_ns": START_NS, "to_ns": START_NS + 9_000_000_000_i64,
        "first_ns": null, "last_ns": null, "lambdas": [], "triggers": 1, "moments": [], "topics": [], "incomplete": ["it is short"],
        "recovered": null,
    })
}

#[test]
fn the_page_has_the_data_of_the_files() {
    let out = Out::new();
    let fault = json!({"kind": "fuel", "message": "out of fuel", "used": 50_000_001, "allowed": 50_000_000});
    out.decisions(&[
        wake(1500, json!([trigger("brake", 1.5), trigger("dark", 0.5)]), Value::Null),
        wake(2000, json!([]), fault),
    ]);
    out.write(
        "log.jsonl",
        format!("{}\n", json!({"at_ns": START_NS + 5, "level": "warn", "message": "hm"})),
    );
    out.write("signals.json", signals().to_string());
    out.write("clips.jsonl", format!("{}\n", clip("clips/a.jpg")));
    out.write("clips/a.jpg", JPEG);
    let run = out.data();

    assert_eq!(run["labels"], json!(["brake", "dark"]));
    assert_eq!(run["triggers"][0]["t"], 1.5);
    // A script would round this number.
    assert_eq!(
        run["triggers"][0]["attributes"],
        json!([["mps2", "-1.5"], ["serial", "9007199254740993"]])
    );
    assert_eq!(
        run["fault_causes"][0]["amounts"],
        json!({"used": "50,000,001", "allowed": "50,000,000"})
    );
    assert_eq!((&run["from"], &run["to"]), (&json!(0.0), &json!(40.0)));
    assert_eq!(run["config"], json!({"brake_mps2": -1.4, "name": "x"}));
    let curve = &run["curves"][0];
    assert_eq!(
        (&curve["t"], &curve["min"], &curve["max"]),
        (&json!([0.0, 0.5]), &json!([0.123456789, -1.0]), &json!([0.5, 2.0]))
    );
    assert_eq!(run["spreads"][1]["bins"], json!([[1000, 2000, 150], [2000, 9001, 250]]));
    assert_eq!(run["topics"][0]["lost"], Value::Null, "unknown is never 0");
    assert_eq!(run["clips"][0]["incomplete"], json!(["it is short"]));
    // Both triggers are in the clip, whose thumbnail is shown unless there is a camera picture.
    assert_eq!(
        (&run["triggers"][0]["pictures"], &run["triggers"][1]["pictures"]),
        (&json!([0]), &json!([0]))
    );
    assert_eq!(run["pictures"][0]["src"], "data:image/jpeg;base64,/9j/4AECAw==");
    assert_eq!(run["notes"], json!([]));
}

#[test]
fn a_camera_picture_is_preferred_to_a_thumbnail() {
    let out = Out::new();
    out.decisions(&[wake(1500, json!([trigger("brake", 1.5)]), Value::Null)]);
    let mut signals = signals();
    let at_ns = START_NS + 1_500_000_000;
    signals["pictures"] = json!([{"at_ns": at_ns, "topic": "/camera", "image_ns": at_ns - 20_000_000, "file": "pictures/1.jpg"}]);
    out.write("signals.json", signals.to_string());
    out.write("pictures/1.jpg", JPEG);
    out.write("clips.jsonl", format!("{}\n", clip("clips/a.jpg")));
    out.write("clips/a.jpg", JPEG);
    let run = out.data();
    assert_eq!(run["pictures"].as_array().unwrap().len(), 1);
    assert_eq!(
        (&run["pictures"][0]["source"], &run["pictures"][0]["age"]),
        (&json!("/camera"), &json!(0.02))
    );
    assert_eq!(run["triggers"][0]["pictures"], json!([0]));
}

#[test]
fn two_runs_count_from_the_start_of_the_first() {
    let (a, b) = (Out::new(), Out::new());
    let mut later = summary();
    later["start_ns"] = (START_NS + 10_000_000_000).into();
    later["part"] = json!({"from_ns": START_NS + 12_000_000_000_i64, "to_ns": null});
    b.write("summary.json", later.to_string());
    b.write(
        "log.jsonl",
        format!(
            "{}\n",
            json!({"at_ns": START_NS + 5_000_000_000, "level": "warn", "message": "hm"})
        ),
    );
    let both = [wake(15_000, json!([trigger("brake", 1.5)]), Value::Null)];
    a.decisions(&both);
    b.decisions(
        &[&both[..], &[wake(20_000, json!([trigger("brake", 1.5)]), Value::Null)]].concat(),
    );
    for (first, second, new_s, [from_a, from_b]) in
        [(&a, &b, 20.0, [0.0, 12.0]), (&b, &a, 10.0, [2.0, -10.0])]
    {
        let diff = Diff::between(first.path(), second.path()).unwrap();
        let html = ReportPage::of_both(first.path(), second.path(), diff).unwrap().to_html();
        let (_, data) = html.split_once("application/json\">").unwrap();
        let data: Value = serde_json::from_str(data.split_once("</script>").unwrap().0).unwrap();
        let run = |n: usize| &data["runs"][n];
        assert_eq!(
            run(0)["triggers"][0]["t"],
            run(1)["triggers"][0]["t"],
            "one instant has one time in both runs"
        );
        assert_eq!((&run(0)["from"], &run(1)["from"]), (&json!(from_a), &json!(from_b)));
        assert_eq!(
            (&run(0)["start_ms"], &data["diff"]["differences"][0]["t"]),
            (&run(1)["start_ms"], &json!(new_s))
        );
    }
}

#[test]
fn a_run_without_signals_has_a_report() {
    let run = Out::new().data();
    assert_eq!(
        (&run["config"], &run["curves"], &run["spreads"]),
        (&Value::Null, &json!([]), &json!([]))
    );
    assert_eq!(run["notes"], json!([]));
}

#[test]
fn hostile_texts_stay_texts() {
    let (out, hostile) = (Out::new(), "</script><script>alert(1)</script>\u{2028}");
    let mut decision = wake(
        1,
        json!([trigger(hostile, 1.0)]),
        json!({"kind": "trap", "message": hostile, "used": null, "allowed": null}),
    );
    decision["topic"] = hostile.into();
    decision["triggers"][0]["attributes"] = json!({hostile: hostile});
    out.decisions(&[decision]);
    out.write(
        "log.jsonl",
        format!("{}\n", json!({"at_ns": START_NS, "level": hostile, "message": hostile})),
    );
    let html = ReportPage::of(out.path()).unwrap().to_html();
    assert!(!html.contains("<script>alert") && !html.contains('\u{2028}'));
    let (_, data) = html.split_once("application/json\">").unwrap();
    let data: Value = serde_json::from_str(data.split_once("</script>").unwrap().0).unwrap();
    assert_eq!(data["runs"][0]["labels"][0], hostile, "the label is in the data unchanged");
}

#[test]
fn lines_that_cannot_be_parsed_are_counted_and_the_others_are_shown() {
    let out = Out::new();
    let long = format!("{{\"at_ns\":{}}}", "1".repeat(20 << 20));
    let good = wake(1500, json!([trigger("brake", 1.5)]), Value::Null);
    out.write("decisions.jsonl", format!("{{\n\u{0}\n{good}\n{{\"at_ns\":5,\n{long}"));
    let run = out.data();
    assert_eq!(run["triggers"].as_array().unwrap().len(), 1);
    let note = run["notes"][0].as_str().unwrap();
    assert!(
        note.starts_with("4 lines of `decisions.jsonl` omitted; the first: ")
            && note.contains("line 1"),
        "{note}"
    );
}

#[test]
fn nothing_outside_of_the_result_folder_is_read() {
    let (out, elsewhere) = (Out::new(), Out::new());
    elsewhere.write("secret.jpg", JPEG);
    let secret = elsewhere.path().join("secret.jpg");
    std::os::unix::fs::symlink(&secret, out.path().join("link.jpg")).unwrap();
    out.write("note.jpg", "no picture");
    out.write("large.jpg", [JPEG, &vec![0; 1 << 20]].concat());
    let up = format!("../{}/secret.jpg", elsewhere.path().file_name().unwrap().to_str().unwrap());
    out.decisions(&[wake(1500, json!([trigger("brake", 1.5)]), Value::Null)]);
    for (file, why) in [
        (up.as_str(), "outside of the result folder"),
        (secret.to_str().unwrap(), "outside of the result folder"),
        ("link.jpg", "secret.jpg`, outside of"),
        ("../../x", "outside of the result folder"),
        ("note.jpg", "not a JPEG file"),
        ("large.jpg", "at most 1 MiB are read"),
        ("none.jpg", "No such file"),
        ("", "it is not a regular file"),
    ] {
        out.write("clips.jsonl", format!("{}\n", clip(file)));
        let run = out.data();
        assert_eq!(run["pictures"], json!([]), "{file}");
        let note = run["notes"][0].as_str().unwrap();
        assert!(note.contains(why), "{file}: {note}");
    }
}

#[test]
fn a_page_has_bounds_and_counts_what_it_omits() {
    let out = Out::new();
    let fault = |n: usize| json!({"kind": "exception", "message": "x".repeat(n + 1), "used": null, "allowed": null});
    let many: Vec<_> = (0..6000)
        .map(|n| wake(n as i64, json!([trigger(&format!("l{}", n % 40), 1.0)]), fault(n % 300)))
        .collect();
    out.decisions(&many);
    let line = |n: i64| {
        json!({"at_ns": START_NS + n, "level": "info", "message": "x".repeat(5000)}).to_string()
            + "\n"
    };
    out.write("log.jsonl", (0..3000).map(line).collect::<String>());
    let run = out.data();
    let length = |key: &str| run[key].as_array().unwrap().len();
    assert_eq!((length("triggers"), &run["totals"]["triggers"]), (5000, &json!(6000)));
    assert_eq!((length("faults"), &run["totals"]["faults"]), (500, &json!(6000)));
    assert_eq!((length("fault_causes"), &run["totals"]["unlisted_faults"]), (100, &json!(4000)));
    assert_eq!(length("labels"), 25, "the last one is for all other labels");
    let dense = |key: &str| {
        run[key].as_array().unwrap().iter().map(|bin| bin["count"].as_u64().unwrap()).sum::<u64>()
    };
    assert_eq!((dense("trigger_density"), dense("fault_density")), (6000, 6000));
    assert!(
        length("log") < 2000 && run["totals"]["log"] == 3000,
        "each line is cut, and all share a budget"
    );
    let html = ReportPage::of(out.path()).unwrap().to_html();
    assert!(html.len() < 10 << 20, "{}", html.len());
}

#[test]
fn names_values_and_lists_have_bounds_too() {
    let (out, other, long) = (Out::new(), Out::new(), "<".repeat(10_000));
    let list = |n: usize| (0..n).map(|n| format!("{n}{long}")).collect::<Vec<_>>();
    let mut summary = summary();
    for key in ["lambda", "version", "damaged"] {
        summary[key] = long.clone().into();
    }
    summary["drive"] = list(60).into();
    let topic = |name: String| json!({"name": name, "topic": name, "type_name": name, "received": 1, "lost": null, "overwritten": 0, "no_slot": 0, "too_big": 0});
    summary["topics"] =
        list(270).into_iter().map(|name| topic(name.chars().take(4_000).collect())).collect();
    out.write("summary.json", summary.to_string());
    let mut signals = signals();
    signals["config"] = list(250)
        .into_iter()
        .map(|key| (key.clone(), key.into()))
        .collect::<serde_json::Map<_, _>>()
        .into();
    out.write("signals.json", signals.to_string());
    let run = out.data();
    assert_eq!(
        (run["drive"].as_array().unwrap().len(), run["topics"].as_array().unwrap().len()),
        (50, 256)
    );
    assert_eq!(run["config"].as_object().unwrap().len(), 200);
    let notes = run["notes"].to_string();
    for omitted in ["10 of 60 drives", "14 of 270 topics", "50 of 250 config values"] {
        assert!(notes.contains(omitted), "{notes}");
    }
    signals["config"] = json!({});
    other.write("signals.json", signals.to_string());
    let diff = Diff::between(out.path(), other.path()).unwrap();
    let notes = &diff.notes;
    assert!(notes.iter().any(|note| note == "50 more config values differ"), "{notes:?}");
    let bytes = ReportPage::of_both(out.path(), other.path(), diff).unwrap().to_html().len();
    assert!(bytes < 8 << 20, "{bytes}");
}

#[test]
fn the_budget_counts_escaped_texts() {
    let out = Out::new();
    let mut one = trigger("x", 1.0);
    one["attributes"] = json!({"text": "<".repeat(300)});
    out.decisions(&(0..5000).map(|ms| wake(ms, json!([one]), Value::Null)).collect::<Vec<_>>());
    let run = out.data();
    let shown = run["triggers"].as_array().unwrap().len();
    assert!(shown > 500 && shown < 2000, "{shown}");
    assert_eq!(run["totals"]["triggers"], 5000);
    assert!(
        run["trigger_density"].as_array().is_some_and(|bins| !bins.is_empty()),
        "the omitted ones are in the density"
    );
}

#[test]
fn inconsistent_curves_are_omitted_with_a_note() {
    let out = Out::new();
    let mut signals = signals();
    signals["curves"][0]["min"] = json!([1.0]);
    out.write("signals.json", signals.to_string());
    let run = out.data();
    assert_eq!(run["curves"], json!([]));
    assert!(
        run["notes"][0].as_str().unwrap().contains("1 of 1 inconsistent curves"),
        "{}",
        run["notes"]
    );
    out.write("signals.json", "{");
    assert!(out.data()["notes"][0].as_str().unwrap().starts_with("cannot parse `signals.json`"));
}

#[test]
fn a_folder_without_results_is_refused_with_help() {
    let out = Out::new();
    out.write("hello/summary.json", summary().to_string());
    fs::remove_file(out.path().join("summary.json")).unwrap();
    let failure = Failure::from(ReportPage::of(out.path()).unwrap_err());
    assert_eq!(failure.exit, Exit::Usage);
    assert!(failure.help.as_ref().unwrap().contains("hello`"), "{failure}");
    out.write("summary.json", "{}");
    let failure = Failure::from(ReportPage::of(out.path()).unwrap_err());
    assert!(failure.to_string().contains("missing field `lambda`"), "{failure}");
}

#[test]
fn the_report_of_a_live_run_begins_with_its_first_event() {
    let out = Out::new();
    let topic = json!({"name": "imu", "topic": "/imu", "type_name": "sensor_msgs/msg/Imu", "writers": 1, "rate_hz": 100.0, "received": 7,
        "lost": 2, "malformed": 1, "overwritten": 0, "no_slot": 0, "too_big": 0, "skipped": 0, "age_ns": null, "qos": null, "qos_warnings": ["it is far"]});
    let recorded = RecordedTopic { no_slot: 8, ..RecordedTopic::default() };
    let recording = RecorderStatus {
        recording: RecordingCounts { disk_suppressed: 6, ..RecordingCounts::default() },
        topics: vec![recorded],
        ..RecorderStatus::default()
    };
    let live = json!({"lambda": "hello", "version": "0.1.0", "kind": "python", "out": "x", "restarts": 1, "up_s": 3.0, "wakes": 7, "triggers": 1,
        "faults": 0, "skipped": 0, "missed_ticks": 0, "log_lines": 0, "log_dropped": 0, "triggers_refused": 0, "backed_off": 0,
        "unwritten": 4, "unsent": 0, "wake_latency": null, "run_time": {"n": 7, "p50_ns": 10, "p99_ns": 20, "max_ns": 30}, "decision_latency": null,
        "topics": [topic], "network": {"domain": 0, "participants": 1, "buffer_requested": 1, "buffer_granted": 1, "socket_drops": 5},
        "recorder_link": null, "recording": recording, "rss_bytes": 1, "cpu_s": 0.5});
    out.write("summary.json", live.to_string());
    out.decisions(&[wake(1500, json!([trigger("brake", 1.5)]), Value::Null)]);
    let run = out.data();
    assert_eq!(
        (&run["is_live"], &run["triggers"][0]["t"], &run["kind"]),
        (&json!(true), &json!(0.0), &json!("python"))
    );
    assert_eq!(run["spreads"][0]["quantiles"], json!([["p50", 10], ["p99", 20], ["max", 30]]));
    assert_eq!((&run["topics"][0]["lost"], &run["topics"][0]["malformed"]), (&json!(2), &json!(1)));
    for missed in [
        json!(["decisions and log lines not written", 4]),
        json!(["triggers without a window: the disk was too full", 6]),
        json!(["samples to record, no free slot: recorder busy", 8]),
    ] {
        assert!(run["missed"].as_array().unwrap().contains(&missed), "{missed}: {}", run["missed"]);
    }
    assert!(run["facts"].as_array().unwrap().iter().any(|fact| fact["text"] == "it is far"));
}
