//! Tests of [`Diff`] on results that the tests write.

use gleaner_base::{Exit, Explain};
use serde_json::{Value, json};

use super::{ChangeCounts, Diff, Difference, ValueChange};
use crate::tests::{Out, START_NS, summary, trigger, wake};

fn out(decisions: &[Value]) -> Out {
    let out = Out::new();
    out.decisions(decisions);
    out
}

fn diff(a: &[Value], b: &[Value]) -> Diff {
    Diff::between(out(a).path(), out(b).path()).unwrap()
}

fn one(ms: i64, label: &str, score: f64) -> Value {
    wake(ms, json!([trigger(label, score)]), Value::Null)
}

fn faulty(ms: i64, kind: &str, message: &str) -> Value {
    wake(ms, json!([]), json!({"kind": kind, "message": message, "used": null, "allowed": null}))
}

fn lines(diff: &Diff) -> Vec<String> {
    let line = |one: &Difference| {
        format!("{:?} {:?}: {}, {}", one.kind, one.change, one.label, one.detail)
    };
    diff.differences.iter().map(line).collect()
}

#[test]
fn runs_with_the_same_decisions_do_not_differ() {
    let decisions = [one(1, "brake", 1.5), faulty(2, "trap", "x"), one(3, "brake", 2.5)];
    let mut twin = decisions.clone();
    twin[0]["fuel"] = 7.into();
    twin[0]["run_ns"] = 8.into();
    // Within the tolerance of scores.
    twin[2]["triggers"][0]["score"] = 2.500_001.into();
    let diff = diff(&decisions, &twin);
    assert!(diff.identical);
    assert_eq!(diff.triggers, ChangeCounts { identical: 2, ..ChangeCounts::default() });
    assert_eq!(diff.faults, ChangeCounts { identical: 1, ..ChangeCounts::default() });
    assert!(diff.differences.is_empty());
}

#[test]
fn quiet_wakes_are_ignored() {
    let quiet = |ms| wake(ms, json!([]), Value::Null);
    let diff = diff(&[quiet(0), one(1, "brake", 1.5), quiet(2)], &[one(1, "brake", 1.5)]);
    assert!(diff.identical);
}

#[test]
fn triggers_are_removed_added_or_changed() {
    let a =
        [one(1, "removed", 1.0), one(2, "score", 1.0), one(3, "label", 1.0), one(5, "same", 1.0)];
    let b = [one(2, "score", 1.5), one(3, "other", 1.0), one(4, "added", 2.0), one(5, "same", 1.0)];
    let diff = diff(&a, &b);
    assert!(!diff.identical);
    assert_eq!(diff.triggers, ChangeCounts { identical: 1, removed: 1, added: 1, changed: 2 });
    assert_eq!(
        lines(&diff),
        [
            "Trigger Removed: removed, 1",
            "Trigger Changed: score, score 1 → 1.5",
            "Trigger Changed: label → other, ",
            "Trigger Added: added, 2",
        ]
    );
    assert_eq!(diff.differences[3].t, 0.004);
    assert_eq!(diff.differences[3].at_ns, START_NS + 4_000_000);
}

#[test]
fn attributes_are_compared_and_their_numbers_have_the_tolerance_of_scores() {
    let with = |attributes: Value| {
        let mut trigger = trigger("x", 1.0);
        trigger["attributes"] = attributes;
        wake(1, json!([trigger]), Value::Null)
    };
    let a = with(json!({"mps2": -4.5, "n": 7, "word": "a", "old": true}));
    assert!(
        diff(
            std::slice::from_ref(&a),
            &[with(json!({"mps2": -4.500_001, "n": 7, "word": "a", "old": true}))]
        )
        .identical
    );
    let diff = diff(&[a], &[with(json!({"mps2": -4.6, "n": 8, "word": "a", "young": null}))]);
    assert_eq!(
        lines(&diff),
        ["Trigger Changed: x, mps2 -4.5 → -4.6, n 7 → 8, old true → none, young none → null"]
    );
}

#[test]
fn several_triggers_of_one_wake_are_paired_by_their_labels() {
    let wake = |triggers: &[(&str, f64)]| {
        wake(1, triggers.iter().map(|(label, score)| trigger(label, *score)).collect(), Value::Null)
    };
    let diff = diff(
        &[wake(&[("a", 1.0), ("b", 1.0), ("b", 2.0)])],
        &[wake(&[("b", 1.0), ("b", 2.0), ("a", 1.0), ("c", 3.0)])],
    );
    assert_eq!(diff.triggers, ChangeCounts { identical: 3, added: 1, ..ChangeCounts::default() });
}

#[test]
fn wakes_of_one_instant_are_paired_by_topic_then_by_number_then_by_order() {
    let on = |topic: &str, seq: u64, label: &str| {
        let mut wake = one(1, label, 1.0);
        wake["topic"] = topic.into();
        wake["seq"] = seq.into();
        wake
    };
    let (a, b, c) = (on("/a", 1, "a"), on("/b", 1, "b"), on("/b", 2, "c"));
    assert!(diff(&[a.clone(), b.clone(), c.clone()], &[c.clone(), a.clone(), b.clone()]).identical);
    let other_number = diff(&[a.clone(), b.clone()], &[a.clone(), c]);
    assert_eq!(lines(&other_number), ["Trigger Changed: b → c, "]);
    assert_eq!(
        diff(&[a], &[b]).triggers,
        ChangeCounts { removed: 1, added: 1, ..ChangeCounts::default() }
    );
}

#[test]
fn a_part_of_a_drive_numbers_its_samples_from_its_start_and_has_the_same_decisions() {
    let whole: Vec<_> = (0..30).map(|ms| one(ms / 2, "brake", 1.0)).collect();
    let mut part = whole[10..20].to_vec();
    for (seq, wake) in (1_u64..).zip(&mut part) {
        wake["seq"] = seq.into();
    }
    assert_eq!(
        diff(&whole, &part).triggers,
        ChangeCounts { identical: 10, removed: 20, ..ChangeCounts::default() }
    );
}

#[test]
fn faults_are_removed_added_or_changed() {
    let a = [
        faulty(1, "trap", "x"),
        faulty(2, "fuel", "y"),
        faulty(3, "trap", "z"),
        faulty(4, "trap", "same"),
    ];
    let b = [
        faulty(2, "memory", "y"),
        faulty(3, "trap", "zz"),
        faulty(4, "trap", "same"),
        faulty(5, "trap", "x"),
    ];
    let diff = diff(&a, &b);
    assert_eq!(diff.faults, ChangeCounts { identical: 1, removed: 1, added: 1, changed: 2 });
    assert_eq!(lines(&diff)[1], "Fault Changed: fuel → memory, y → y");
}

#[test]
fn wakes_out_of_order_are_compared_with_a_note() {
    let disorder = [one(5, "a", 1.0), one(1, "b", 1.0), one(6, "c", 1.0)];
    let alike = diff(&disorder, &disorder);
    assert!(
        alike.identical && alike.notes.iter().any(|note| note.contains("not in the order")),
        "{:?}",
        alike.notes
    );
}

#[test]
fn different_lambdas_and_drives_are_noted_first() {
    let (a, b) = (out(&[]), out(&[]));
    let mut other = summary();
    other["lambda"] = "brake-dark".into();
    other["kind"] = "python".into();
    other["drive"] = json!(["b.mcap"]);
    other["end_ns"] = (START_NS + 1).into();
    other["wakes"] = 500.into();
    other["topics"][0]["lost"] = 4.into();
    b.write("summary.json", other.to_string());
    let diff = Diff::between(a.path(), b.path()).unwrap();
    assert!(diff.identical, "the decisions are identical");
    assert_eq!(
        diff.notes[..3],
        [
            "different lambdas: `hello` and `brake-dark`",
            "different kinds: wasm and python",
            "different drives: `a.mcap` and `b.mcap`"
        ]
    );
    let change = |what: &str, a: Option<&str>, b: &str| ValueChange {
        what: what.to_owned(),
        a: a.map(str::to_owned),
        b: Some(b.to_owned()),
    };
    let changes =
        [change("wakes", Some("400"), "500"), change("samples of `imu`, lost upstream", None, "4")];
    assert_eq!(diff.counts, changes);
}

#[test]
fn config_and_cost_are_compared_if_both_runs_have_them() {
    let signals = |brake: f64, p50: u64| {
        let spread =
            json!({"count": 9, "min": 1, "p50": p50, "p90": 3, "p99": 4, "max": 5, "bins": []});
        json!({"config": {"brake": brake, "same": 1}, "curves": [], "curves_omitted": 0, "run_ns": spread, "fuel": spread,
            "pictures": [], "pictures_omitted": 0}).to_string()
    };
    let (a, b) = (out(&[]), out(&[]));
    a.write("signals.json", signals(-1.4, 2000));
    let only_one = Diff::between(a.path(), b.path()).unwrap();
    assert!(only_one.config.is_empty() && only_one.notes[0].contains("config not compared"));
    assert_eq!((only_one.cost[0].b, only_one.cost[0].ratio), (None, None));
    b.write("signals.json", signals(-2.0, 3000));
    let diff = Diff::between(a.path(), b.path()).unwrap();
    assert_eq!(diff.notes, [""; 0]);
    let [config] = &diff.config[..] else { panic!("{:?}", diff.config) };
    assert_eq!(
        (&*config.what, config.a.as_deref(), config.b.as_deref()),
        ("brake", Some("-1.4"), Some("-2.0"))
    );
    assert_eq!(
        (diff.cost[0].a, diff.cost[0].b, diff.cost[0].ratio),
        (Some(2000), Some(3000), Some(1.5))
    );
}

#[test]
fn of_many_differences_the_first_are_listed_and_all_are_counted() {
    let a: Vec<_> = (0..3000).map(|ms| one(ms, "removed", 1.0)).collect();
    let b: Vec<_> = (3000..3030).map(|ms| one(ms, "added", 1.0)).collect();
    let diff = diff(&a, &b);
    assert_eq!(diff.triggers, ChangeCounts { identical: 0, removed: 3000, added: 30, changed: 0 });
    // Rare differences are not crowded out.
    assert_eq!((diff.differences.len(), diff.omitted), (1020, 2010));
}

#[test]
fn the_wakes_of_one_instant_are_bounded_in_bytes() {
    let large = |ms: i64| one(ms, &"x".repeat(9 << 20), 1.0);
    let apart: Vec<_> = (0..4).map(large).collect();
    assert_eq!(diff(&apart, &[]).triggers, ChangeCounts { removed: 4, ..ChangeCounts::default() });
    let (a, b) = (out(&[]), out(&vec![large(1); 4]));
    let error = Diff::between(a.path(), b.path()).unwrap_err();
    let named = error.to_string().starts_with(&format!("`{}` has more than", b.path().display()));
    assert!(named && error.to_string().contains("32 MiB"), "{error}");
}

#[test]
fn a_folder_without_results_is_refused() {
    let (whole, broken) = (out(&[]), out(&[]));
    broken.write("decisions.jsonl", "{\"at_ns\":1");
    let error = Diff::between(whole.path(), broken.path()).unwrap_err();
    assert_eq!(error.exit(), Exit::Usage);
    assert!(
        error.to_string().ends_with("line 1, is not a line that gleaner writes")
            && error.help().is_some(),
        "{error}"
    );
    std::fs::remove_file(broken.path().join("summary.json")).unwrap();
    let error = Diff::between(broken.path(), whole.path()).unwrap_err();
    assert_eq!(error.exit(), Exit::Usage);
    assert!(error.to_string().ends_with("does not hold results"), "{error}");
}
