//! `vehicles`, `enrol`, `unenrol`, and the commands with `--on`.

use std::fs;
use std::os::unix::fs::PermissionsExt;

use serde_json::{Value, json};

use super::CloudUser;
use super::fake::{FakeServer, problem};
use crate::programs::{self, fails};

pub fn status(deployments: &[Value]) -> Value {
    json!({
        "vehicle": "car-7", "key": "k", "labels": {}, "generation": 1, "capacity": [],
        "orchestrator": { "version": "1", "pid": 1, "up_s": 1.0, "rss_bytes": 1, "cpu_s": 1.0 },
        "deployments": deployments,
    })
}

#[test]
fn vehicles_are_listed_enrolled_once_and_revoked() {
    let user = CloudUser::logged_in();
    let key = gleaner_trust::SecretKey::generate().unwrap().public().to_string();
    let vehicles = json!([{
        "name": "car-7", "labels": {}, "state": "invited", "seen": null, "version": null,
        "key": key, "wanted": 1, "handled": 0, "is_ahead": false, "is_double": true,
        "problems": [{
            "deployment": "brake", "envelope": "e", "title": "it is refused", "is_pending": false,
            "causes": ["no trust root"], "help": "install one",
        }],
        "running": 0, "deployments": 0,
    }]);
    user.cloud.answers("GET /v1/vehicles", &[(200, json!({ "items": vehicles }))]);
    let text = user.done(&["vehicles"]);
    assert!(text.contains("car-7: two machines have its identity"), "{text}");
    assert!(text.ends_with("car-7: brake: it is refused: no trust root. install one\n"), "{text}");
    assert_eq!(user.done(&["vehicles", "keys"]), format!("car-7 {key}\n"));
    assert_eq!(user.json(&["vehicles"]), vehicles);
    let enrolment = json!({
        "gleaner_enrolment": 1, "address": "127.0.0.1:8443", "vehicle": "car-7",
        "authority": "PEM", "token": "token-of-car-7",
    });
    user.cloud.answers("POST /v1/vehicles", &[(200, enrolment.clone())]);
    let enrol = ["vehicles", "enrol", "car-7", "--to", "car-7.json"];
    let text = user.done(&enrol);
    assert!(text.contains("gleaner enrol car-7.json") && !text.contains("token"), "{text}");
    let file = user.path("car-7.json");
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
    let written: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    assert_eq!(written, enrolment);
    user.cloud.seen();
    assert!(user.fails(2, &enrol).contains("`car-7.json` exists"));
    assert!(user.fails(2, &["vehicles", "enrol", "car-7", "--to", "no/file"]).contains("folder"));
    assert!(user.cloud.seen().is_empty(), "the secret of a second enrolment is lost");
    user.cloud.answers("DELETE /v1/vehicles/car-7", &[(204, json!(null))]);
    assert!(user.done(&["vehicles", "revoke", "car-7"]).starts_with("revoked car-7"));
}

#[test]
fn a_vehicle_is_seen_by_way_of_the_cloud() {
    let user = CloudUser::logged_in();
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[(200, status(&[]))]);
    assert!(user.done(&["status", "--on", "car-7"]).starts_with("car-7"));
    assert_eq!(user.json(&["status", "--on", "car-7"])["vehicle"], "car-7");
    assert!(user.done(&["top", "--once", "--on", "car-7"]).contains("car-7"));
    let line = json!({
        "stream": "lambdas/brake", "seq": 1, "time_ns": 1, "boot_ns": 1, "boot": "b",
        "kind": "log", "record": { "level": "info", "message": "hello" },
    });
    let lines = json!(format!("{line}\n{line}\n"));
    let records = "/v1/vehicles/car-7/lambdas/brake/records?last=2&follow=false";
    user.cloud.answers(&format!("GET {records}"), &[(200, lines.clone())]);
    let text = user.done(&["logs", "brake", "--on", "car-7", "-n", "2"]);
    assert_eq!(text.matches("info: hello").count(), 2, "{text}");
    let events = "GET /v1/vehicles/car-7/events?last=100&follow=false";
    user.cloud.answers(events, &[(200, lines.clone())]);
    assert_eq!(user.json_lines(&["events", "--on", "car-7"]), [line.clone(), line]);
    user.cloud.answers(&events.replace("false", "true"), &[(200, lines)]);
    let text = user.fails(5, &["events", "--on", "car-7", "-f"]);
    assert!(text.contains("the stream has ended"), "{text}");
    let text = user.fails(2, &["status", "--on", "car-8"]);
    assert!(text.contains("no answer to GET /v1/vehicles/car-8/status"), "{text}");
    for bad in [&["status", "--on", "../users"][..], &["status", "--on", "a", "--run-dir", "b"]] {
        assert_eq!(programs::output(&mut user.command(bad)).status.code(), Some(2));
    }
}

#[test]
fn listed_events_are_in_the_order_of_boots_and_end_no_line_and_move_no_cursor() {
    let user = CloudUser::logged_in();
    let line = |(boot, boot_ns): (&str, u64), time_ns: i64, kind: &str, text: &str| {
        let record = json!({ "event": kind, "lambda": "a", "text": text, "label": text });
        json!({
            "stream": "events", "seq": 1, "time_ns": time_ns, "boot_ns": boot_ns, "boot": boot,
            "kind": "event", "record": record,
        })
    };
    let hostile = "\u{1b}[2J\u{9b}\u{202e}\nx";
    let [first, second] = [1_533_199_491_136_000_000, 1_533_199_492_000_000_000];
    let mut other = line(("b", 3), second, "ready", "");
    (other["kind"], other["record"]) = (json!("other"), json!(hostile));
    let mut gap = line(("", 0), 0, "gap", "");
    (gap["kind"], gap["record"]) = (json!("other"), json!("gap"));
    let mut of_another_stream = line(("b", 1), first, "b", "c");
    of_another_stream["stream"] = json!("orchestrator");
    // The second start of the machine had an earlier clock.
    let all = [
        line(("b", 2), second, "ready", hostile),
        other.clone(),
        gap,
        of_another_stream,
        line(("d", 1), 1_000_000_000, "d", "e"),
    ];
    let lines = all.map(|line| line.to_string() + "\n").concat();
    let events = "GET /v1/vehicles/car-7/events?last=100&follow=false";
    user.cloud.answers(events, &[(200, json!(lines))]);
    let escaped = r"\u{1b}[2J\u{9b}\u{202e}\nx";
    // JSON escapes in its own way.
    let raw = r#"other        "\u001b[2J\u{9b}\u{202e}\nx""#;
    assert_eq!(
        user.done(&["events", "--on", "car-7"]),
        format!(
            "2018-08-02T08:44:51.136Z b            a: c\n\
             2018-08-02T08:44:52.000Z ready        a: {escaped}\n2018-08-02T08:44:52.000Z {raw}\n\
             no time                  other        \"gap\"\n\
             1970-01-01T00:00:01.000Z d            a: e\n"
        )
    );
    // For programs, they come as they arrived.
    assert_eq!(user.json_lines(&["events", "--on", "car-7"])[1], other);
    let mut vehicle = status(&[]);
    vehicle["vehicle"] = json!(hostile);
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[(200, vehicle)]);
    let text = user.done(&["status", "--on", "car-7"]);
    assert!(text.starts_with(escaped), "{text}");
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[(404, problem(2, hostile))]);
    let text = user.fails(2, &["status", "--on", "car-7"]);
    assert!(text.starts_with(r"error: \u{1b}[2J\u{9b}\u{202e}"), "{text}");
}

#[test]
fn logs_of_an_unknown_deployment_are_an_error_that_names_those_that_exist() {
    let user = CloudUser::logged_in();
    let known = super::fleet::on_vehicle(1, "running");
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[(200, status(&[known]))]);
    for (id, last) in [("nosuch", 1), ("nosuch", 100), ("brake", 100)] {
        let records = format!("/v1/vehicles/car-7/lambdas/{id}/records?last={last}&follow=false");
        user.cloud.answers(&format!("GET {records}"), &[(200, json!(""))]);
    }
    for follow in
        [&["logs", "nosuch", "--on", "car-7"][..], &["logs", "nosuch", "-f", "--on", "car-7"]]
    {
        let text = user.fails(2, follow);
        assert!(text.contains("there is no deployment `nosuch`"), "{text}");
        assert!(text.contains("the deployments are `brake`"), "{text}");
    }
    assert_eq!(user.done(&["logs", "brake", "--on", "car-7"]), "");
}

#[test]
fn a_vehicle_is_enrolled_once_its_cloud_has_connected() {
    let user = CloudUser::new();
    let vehicle = FakeServer::on_socket(&user.path("control.sock"));
    let text = json!({
        "gleaner_enrolment": 1, "address": "10.0.0.1:8443", "vehicle": "car-7",
        "authority": "PEM", "token": "token-of-car-7",
    });
    fs::write(user.path("car-7.json"), text.to_string()).unwrap();
    let with = |address: &str, state: &str, reason: Option<&str>, help: Option<&str>| {
        let mut status = status(&[]);
        status["cloud"] = json!({
            "address": address, "state": state, "reason": reason, "help": help, "since_s": 3.0,
            "generation": 1, "unsent": 12, "certificate_expires": 4102444800_u64,
        });
        (200, status)
    };
    let command = |arguments: &[&str]| {
        let mut command = user.command(arguments);
        command.env("GLEANER_RUN", user.folder.path());
        command
    };
    vehicle.answers("PUT /v1/cloud", &[(200, json!(null))]);
    let connected = with("10.0.0.1:8443", "connected", None, None);
    let former = with("10.0.0.9:8443", "connected", None, None);
    let connecting = with("10.0.0.1:8443", "connecting", Some("no route"), None);
    vehicle.answers("GET /v1/status", &[(200, status(&[])), former, connecting.clone(), connected]);
    let output = programs::output(&mut command(&["enrol", "car-7.json"]));
    let shown = String::from_utf8_lossy(&output.stdout).into_owned();
    let expected = "cloud 10.0.0.1:8443 connected for 3s; 12 unsent records, \
                    certificate until 2100-01-01T00:00:00Z\n";
    assert_eq!(shown, expected, "{}", String::from_utf8_lossy(&output.stderr));
    let seen = vehicle.seen();
    assert_eq!(seen[0].body, text.to_string().into_bytes());
    assert_eq!(seen.len(), 5, "{seen:?}");
    vehicle.answers("GET /v1/status", &[connecting]);
    let text = fails(command(&["enrol", "car-7.json", "--timeout", "1ms"]), 4);
    assert!(text.contains("after 1ms") && text.contains("cause: no route"), "{text}");
    let refused = with("10.0.0.1:8443", "refused", Some("the token was used"), None);
    vehicle.answers("GET /v1/status", std::slice::from_ref(&refused));
    let text = fails(command(&["enrol", "car-7.json"]), 3);
    assert!(text.contains("cause: the token was used"), "{text}");
    let reason = Some("the enrolment is not valid: it was used");
    let helped = with("10.0.0.1:8443", "refused", reason, Some("make another one"));
    vehicle.answers("GET /v1/status", &[helped]);
    assert_eq!(
        fails(command(&["enrol", "car-7.json"]), 3),
        "error: the cloud at 10.0.0.1:8443 refuses this vehicle\n  cause: the enrolment is not \
         valid: it was used\n  help:  make another one\n"
    );
    vehicle.answers("GET /v1/status", &[refused]);
    let output = programs::output(&mut command(&["status"]));
    assert!(String::from_utf8_lossy(&output.stdout).contains("refused for 3s: the token was used"));
    vehicle.answers("PUT /v1/cloud", &[(400, problem(2, "it is for car-8"))]);
    assert!(fails(command(&["enrol", "car-7.json"]), 2).contains("it is for car-8"));
    fs::write(user.path("bad.json"), "{}").unwrap();
    assert!(fails(command(&["enrol", "bad.json"]), 2).contains("not an enrolment"));
    vehicle.answers("DELETE /v1/cloud", &[(200, json!(null))]);
    programs::done(&mut command(&["unenrol"]));
}

impl CloudUser {
    #[track_caller]
    fn json_lines(&self, arguments: &[&str]) -> Vec<Value> {
        let text = self.done(&[arguments, &["--json"]].concat());
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }
}
