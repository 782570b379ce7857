use std::time::Duration;

use gleaner_protocol::vehicle_api::VehicleStatus;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use serde_json::{Value, json};

use super::columns::{self, RowOrder};
use super::metrics::{VehicleMetrics, losses};
use super::page::Page;
use super::{POLLS_KEPT, Polls};

/// A deployment whose process reports `wakes` wakes and `cpu_s` of CPU time `up_s` after its start.
fn deployment(id: &str, up_s: f64, wakes: u64, cpu_s: f64) -> Value {
    let stats = json!({ "n": 9, "p50_ns": 250_000, "p99_ns": 1_500_000, "max_ns": 2_000_000 });
    let topic = json!({
        "name": "imu", "topic": "/imu/data", "type_name": "sensor_msgs/msg/Imu", "writers": 1,
        "rate_hz": 99.96, "received": 900, "lost": 3, "malformed": 1, "overwritten": 700,
        "no_slot": 0, "too_big": 0, "skipped": 5, "age_ns": 20_000_000, "qos": null,
        "qos_warnings": [],
    });
    let network = json!({ "domain": 0, "participants": 1, "buffer_requested": 1,
        "buffer_granted": 1, "socket_drops": 0 });
    let live = json!({
        "lambda": id, "version": "0.1.0", "kind": "wasm", "out": "out", "restarts": 0,
        "up_s": up_s, "wakes": wakes, "triggers": 2, "faults": 1, "skipped": 5, "missed_ticks": 0,
        "log_lines": 0, "log_dropped": 4, "triggers_refused": 0, "backed_off": 0, "unwritten": 0,
        "unsent": 0, "wake_latency": stats, "run_time": stats, "decision_latency": null,
        "topics": [topic], "network": network, "recorder_link": null, "rss_bytes": 21_000_000,
        "cpu_s": cpu_s,
    });
    let layers = json!([{ "name": "files", "holds": "yes", "note": "Landlock" }]);
    let lambda = json!({
        "id": id, "name": id, "revision": "ab", "attempt": 7, "phase": "running", "phase_s": 61.0,
        "pid": 321, "restarts": 0, "last_end": null, "live": live, "layers": layers,
    });
    let revision = json!({ "digest": "ab", "version": "0.1.0", "release": 1 });
    json!({
        "id": id, "release": 1, "attempt": 7, "lambda": id, "revision": revision, "fallback": null,
        "grants": { "topics": [], "models": [], "record": true }, "is_wanted": true,
        "runs_fallback": false, "is_proven": true, "failed": null, "refused": null, "stale": null,
        "status": lambda,
    })
}

/// A vehicle `up_s` after the start of its programs, which take a tenth of a core each.
fn vehicle(up_s: f64, deployments: Vec<Value>) -> Value {
    let service = json!({ "is_ready": true, "restarts": 2, "last_end": "killed", "last": null });
    json!({
        "vehicle": "car-7", "key": "k", "labels": {}, "generation": 1, "deployments": deployments,
        "orchestrator": { "version": "0.1.0", "pid": 1, "up_s": up_s, "rss_bytes": 9_000_000,
            "cpu_s": up_s / 10.0 },
        "trust": { "version": 3, "expires": 0, "is_expired": false },
        "capacity": [
            { "resource": "memory", "unit": "B", "asked": 1_048_576.0, "most": 8_388_608.0,
                "source": "half" },
            { "resource": "cpu", "unit": "cores", "asked": 0.5, "most": 2.0, "source": "machine" },
        ],
        "supervisor": {
            "generation": 1, "up_s": up_s, "lambdas": [], "ingress": service, "recorder": null,
            "inference": null, "clips": 3, "events_lost": 0, "rss_bytes": 4_000_000,
            "cpu_s": up_s / 10.0, "clips_by_lambda": { "hello": { "clips": 3, "bytes": 2048 } },
        },
    })
}

fn status(value: Value) -> VehicleStatus {
    serde_json::from_value(value).unwrap()
}

/// Figures by these statuses of one lambda, the newest first.
fn metrics(deployments: Vec<Value>) -> VehicleMetrics {
    let count = deployments.len();
    let with_time = |(index, it)| status(vehicle((count - index) as f64, vec![it]));
    let polls: Vec<_> = deployments.into_iter().enumerate().map(with_time).collect();
    VehicleMetrics::of(&polls[0], polls[1..].iter())
}

/// Rates of these statuses of one lambda: wakes in 1 s, and percent of a core.
fn rates(deployments: Vec<Value>) -> (Option<f64>, Option<f64>) {
    let lambda = metrics(deployments).lambdas.remove(0);
    (lambda.wakes_per_s, lambda.cpu_percent)
}

fn changed(mut deployment: Value, pointer: &str, value: Value) -> Value {
    *deployment.pointer_mut(pointer).unwrap() = value;
    deployment
}

#[test]
fn a_rate_is_the_growth_between_two_reports_of_a_process() {
    let [first, second] = [deployment("a", 2.0, 100, 1.0), deployment("a", 4.0, 120, 1.5)];
    assert_eq!(rates(vec![second.clone(), first.clone()]), (Some(10.0), Some(25.0)));
    // A report that has not changed is compared with the one before.
    let unchanged = vec![second.clone(), second.clone(), first.clone()];
    assert_eq!(rates(unchanged), (Some(10.0), Some(25.0)));
    assert_eq!(rates(vec![second.clone(), second.clone()]), (None, None));
    assert_eq!(rates(vec![second.clone()]), (None, None));
    let all = metrics(vec![second, first]);
    assert!((all.orchestrator.cpu_percent.unwrap() - 10.0).abs() < 1e-9, "{all:?}");
    assert!((all.supervisor.unwrap().cpu_percent.unwrap() - 10.0).abs() < 1e-9);
}

#[test]
fn another_process_has_no_rate_until_its_second_report() {
    let (before, after) = (deployment("a", 20.0, 500, 9.0), deployment("a", 22.0, 510, 10.0));
    for (field, value) in [("restarts", 1), ("attempt", 8)] {
        let restarted = changed(after.clone(), &format!("/status/{field}"), json!(value));
        assert_eq!(rates(vec![restarted.clone(), before.clone()]), (None, None), "{field}");
        let next = changed(restarted.clone(), "/status/live/up_s", json!(23.0));
        assert_eq!(rates(vec![next, restarted, before.clone()]), (Some(0.0), Some(0.0)));
    }
    // Counts of a supervisor that was started again begin at 0.
    assert_eq!(rates(vec![deployment("a", 1.0, 3, 0.1), before.clone()]), (None, None));
    assert_eq!(rates(vec![deployment("a", 30.0, 3, 0.1), before.clone()]), (None, None));
    let waiting = changed(after, "/status/phase", json!("waiting"));
    assert_eq!(rates(vec![waiting, before.clone()]), (None, None), "it does not run");
    let unknown = changed(before.clone(), "/status", Value::Null);
    assert_eq!(rates(vec![unknown, before]), (None, None));
}

#[test]
fn losses_of_all_causes_are_added() {
    let metrics = metrics(vec![deployment("a", 2.0, 1, 0.1)]);
    assert_eq!(metrics.lambdas[0].losses, Some(3 + 1 + 5 + 4));
    let status = status(vehicle(1.0, vec![deployment("a", 2.0, 1, 0.1)]));
    let live = status.deployments[0].status.as_ref().unwrap().live.as_ref().unwrap();
    let causes: Vec<_> = losses(live).into_iter().map(|(_, what)| what).collect();
    assert_eq!(
        causes,
        [
            "3 samples of /imu/data, lost before their reception",
            "5 samples of /imu/data, woke nothing",
            "1 sample of /imu/data, malformed",
            "4 log lines, over the rate limit",
        ]
    );
}

#[test]
fn the_json_has_rates_and_unknown_ones_are_null() {
    let json = serde_json::to_value(metrics(vec![deployment("hello", 2.0, 1, 0.1)])).unwrap();
    assert_eq!(json["lambdas"][0]["wakes_per_s"], Value::Null);
    assert_eq!(json["lambdas"][0]["clips"], 3);
    assert_eq!(json["lambdas"][0]["clip_bytes"], 2048);
    assert_eq!(json["services"][0]["name"], "ingress");
}

#[test]
fn rows_are_sorted_by_the_highest_number_and_unknown_ones_come_last() {
    let ids = |order: RowOrder| {
        let lambdas = vec![
            deployment("b", 4.0, 40, 1.0),
            deployment("a", 4.0, 80, 1.0),
            changed(deployment("c", 4.0, 90, 1.0), "/status/live", Value::Null),
        ];
        let before = vec![deployment("b", 2.0, 0, 0.0), deployment("a", 2.0, 0, 0.5)];
        let [now, before] = [lambdas, before].map(|it| status(vehicle(1.0, it)));
        let mut lambdas = VehicleMetrics::of(&now, [before].iter()).lambdas;
        order.sort(&mut lambdas);
        lambdas.into_iter().map(|it| it.id).collect::<String>()
    };
    assert_eq!(ids(RowOrder::Id), "abc");
    assert_eq!(ids(RowOrder::Wakes), "abc");
    assert_eq!(ids(RowOrder::Cpu), "bac");
}

fn page(deployments: impl Fn(f64) -> Vec<Value>) -> Page {
    let mut polls = Polls::default();
    for up_s in [10.0, 11.0] {
        polls.add(status(vehicle(up_s, deployments(up_s))));
    }
    Page::new(polls)
}

fn two(up_s: f64) -> Vec<Value> {
    let wakes = (up_s * 100.0) as u64;
    vec![deployment("hello", up_s, wakes, up_s / 4.0), deployment("second", up_s, wakes, 0.0)]
}

/// The lines of the page on a terminal of this size.
fn drawn(page: &mut Page, width: u16, height: u16, silent_s: u64) -> Vec<String> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| page.draw(frame, Duration::from_secs(silent_s))).unwrap();
    let buffer = terminal.backend().buffer();
    let symbols: Vec<_> = buffer.content().iter().map(|cell| cell.symbol()).collect();
    let lines = symbols.chunks(width.into()).map(|line| line.concat().trim_end().to_owned());
    lines.collect()
}

#[test]
fn a_wide_page_shows_all_columns() {
    let lines = drawn(&mut page(two), 140, 30, 0);
    assert_eq!(
        lines[..8],
        [
            "car-7   trust root 3",
            "orchestrator CPU 10.0 %, 8.6 MiB   supervisor CPU 10.0 %, 3.8 MiB",
            "ingress, restarts 2",
            "memory: 1.0 MiB reserved of 8.0 MiB allowed   cpu: 0.50 cores reserved of 2.00 cores allowed",
            "",
            concat!(
                "id      state    wakes/s  p50 ms  p99 ms  run p99  CPU %    memory  lost  faults",
                "  restarts  triggers  clips  recorded  wakes",
            ),
            concat!(
                "hello   running    100.0    0.25    1.50     1.50   25.0  20.0 MiB    13       1",
                "         0         2      3     2 KiB  1,100",
            ),
            concat!(
                "second  running    100.0    0.25    1.50     1.50    0.0  20.0 MiB    13       1",
                "         0         2      0       0 B  1,100",
            ),
        ]
    );
    assert!(lines[9].starts_with("─ hello ─"), "{lines:#?}");
    let rest = lines[10..].join("\n");
    for part in [
        "hello 0.1.0, running for 61s, process 321",
        "lost: 4 log lines, over the rate limit",
        "wake latency 0.25 / 1.50 / 2.00, run time 0.25 / 1.50 / 2.00 ms (p50 / p99 / max)",
        "/imu/data  100.0     3  0.0 s",
        "isolation: files active",
    ] {
        assert!(rest.contains(part), "{part}: {lines:#?}");
    }
}

#[test]
fn a_narrow_page_has_the_columns_that_fit_and_the_details() {
    let lines = drawn(&mut page(two), 80, 24, 0);
    assert_eq!(
        lines[6..8],
        [
            "id      state    wakes/s  p99 ms  CPU %    memory  lost  faults  restarts",
            "hello   running    100.0    1.50   25.0  20.0 MiB    13       1         0",
        ]
    );
    assert!(lines[23].starts_with("q quit") && lines.iter().any(|it| it.contains("/imu/data")));
    // Nothing fits, and nothing fails.
    for (width, height) in [(1, 1), (3, 2), (10, 5), (20, 8)] {
        drawn(&mut page(two), width, height, 0);
    }
}

#[test]
fn keys_select_and_sort() {
    let mut page = page(two);
    page.select(1);
    page.select(1);
    assert!(drawn(&mut page, 80, 24, 0).iter().any(|it| it.starts_with("─ second ─")));
    // The selection stays with its lambda.
    page.sort();
    let lines = drawn(&mut page, 80, 24, 0);
    assert!(lines[23].ends_with("sort: CPU %"), "{lines:#?}");
    page.select(-5);
    assert!(drawn(&mut page, 80, 24, 0).iter().any(|it| it.starts_with("─ hello ─")));
}

#[test]
fn the_reason_of_a_quarantine_is_shown_without_control_characters() {
    let mut page = page(|up_s| {
        let lambda = deployment("hello", up_s, 5, 1.0);
        let lambda = changed(lambda, "/status/phase", json!("quarantined"));
        vec![changed(lambda, "/status/last_end", json!("killed \u{1b}[2Jby SIGKILL"))]
    });
    let lines = drawn(&mut page, 80, 24, 0);
    assert!(lines[7].starts_with("hello  quarantined        -"), "{lines:#?}");
    assert!(lines.iter().any(|it| it == r"last end: killed \u{1b}[2Jby SIGKILL"), "{lines:#?}");
}

#[test]
fn a_lost_connection_is_shown_until_the_next_answer() {
    let mut page = page(two);
    page.add(Err("cannot reach gleaner-orchestrator".to_owned()));
    let lines = drawn(&mut page, 80, 24, 65);
    assert_eq!(lines[0], "no connection for 65s: cannot reach gleaner-orchestrator");
    assert!(lines[8].starts_with("hello   running"), "the last figures stay: {lines:#?}");
    page.add(Ok(status(vehicle(12.0, two(12.0)))));
    assert!(drawn(&mut page, 80, 24, 0)[0].starts_with("car-7"));
    // One that is stopped answers with nothing.
    assert_eq!(drawn(&mut page, 80, 24, 4)[0], "no connection for 4s: it does not answer");
}

#[test]
fn a_vehicle_without_deployments_shows_that() {
    let lines = drawn(&mut page(|_| Vec::new()), 80, 24, 0);
    assert!(lines.iter().any(|it| it.starts_with("nothing is deployed")), "{lines:#?}");
}

#[test]
fn text_has_every_column_and_the_reasons() {
    let lambda = deployment("hello", 2.0, 100, 1.0);
    let text =
        columns::text(&metrics(vec![changed(lambda, "/refused", json!("unsigned"))]), usize::MAX);
    assert!(text.contains("id     state    wakes/s  p50 ms"), "{text}");
    assert!(text.contains("hello  running        -    0.25"), "{text}");
    assert!(text.ends_with("hello: refused: unsigned\n"), "{text}");
}

#[test]
fn old_statuses_are_dropped() {
    let mut polls = Polls::default();
    (0..9).for_each(|up_s| polls.add(status(vehicle(up_s.into(), Vec::new()))));
    assert_eq!(polls.0.len(), POLLS_KEPT);
}

#[test]
fn the_status_shows_events_that_were_lost() {
    let mut vehicle = vehicle(1.0, Vec::new());
    let text = |vehicle: &Value| {
        crate::vehicle::status::text(&status(vehicle.clone()), crate::render::Paint::new(false))
    };
    assert!(!text(&vehicle).contains("lost"), "also of an orchestrator that does not count them");
    vehicle["events_lost"] = 1234.into();
    vehicle["supervisor"]["events_lost"] = 5.into();
    let text = text(&vehicle);
    for line in ["events of the orchestrator lost: 1,234", "events of the supervisor lost: 5"] {
        assert!(text.contains(line), "{text}");
    }
}
