use std::process::Command;

use super::conditions::offered;
use super::*;

const DOCS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/api");

#[tokio::test]
async fn the_committed_descriptions_are_those_of_the_cloud_and_a_foreign_tool_accepts_them() {
    let (_folder, cloud) = Cloud::of_test().await;
    let answer = send(&cloud, (Method::GET, "/v1/openapi.json"), None, &[], "").await;
    assert_eq!(answer.headers[header::CONTENT_TYPE], "application/json");
    let about = "The API of the cloud for vehicles, each with its certificate. `GET /v1/link` \
                 opens the control channel, a WebSocket: see `gleaner_fleet::Frame`.";
    let link = describe("Gleaner cloud for vehicles", about, &crate::endpoints_for_vehicles());
    let fleet = String::from_utf8(answer.body).unwrap();
    for (name, text) in [("fleet", fleet), ("link", link)] {
        let file = format!("{DOCS}/{name}.json");
        if std::env::var_os("GLEANER_BLESS").is_some() {
            std::fs::write(&file, &text).unwrap();
        }
        let is_same = std::fs::read_to_string(&file).unwrap() == text;
        assert!(is_same, "run `cargo xtask bless`, which writes docs/api/{name}.json");
        python("-m", &["openapi_spec_validator", "--errors", "all", &file]);
    }
}

const CHECK: &str = "
import json, sys
from jsonschema import Draft202012Validator
description, answers = (json.load(open(path)) for path in sys.argv[1:])
components = description['components']
for operation, status, answer in answers:
    operation = description['paths'][operation[1]][operation[0]]
    response = operation['responses'].get(status) or components['responses']['Problem']
    (content,) = response['content'].values()
    Draft202012Validator({**content['schema'], 'components': components}).validate(answer)
";

pub(super) async fn announce(store: &CloudStore) {
    let sha256 = gleaner_trust::sha256(b"01234");
    let clip = json!({ "name": "a", "from_ns": -1, "to_ns": 2, "bytes": 5, "sha256": sha256,
                       "thumbnail": null, "triggers": 1,
                       "lambdas": [{ "name": "brake", "version": "1", "digest": "d",
                                     "deployment": null, "revision": null }],
                       "moments": [{ "lambda": "brake", "kind": "event", "label": "x",
                                     "score": 0.5, "attributes": { "a": 1 }, "at_ns": 1 }] });
    let report = json!({ "cursor": "1", "clips": [clip], "gone": [] });
    let report = serde_json::from_value(report).unwrap();
    store.announce_clips("car-7", &report, ClipBounds::DEFAULT).await.unwrap();
}

/// Runs a foreign tool in the environment for tests; prints a line without it.
fn python(option: &str, arguments: &[&str]) {
    let python = concat!(env!("CARGO_MANIFEST_DIR"), "/../.venv/bin/python");
    let tool = "import jsonschema, openapi_spec_validator";
    let has = Command::new(python).args(["-I", "-c", tool]).output();
    if !has.is_ok_and(|output| output.status.success()) {
        println!("not checked: `.venv` has no package openapi-spec-validator");
        return;
    }
    let output = Command::new(python).args(["-I", option]).args(arguments).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&text));
}

#[tokio::test]
async fn each_answer_has_the_form_that_the_description_states() {
    let (folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Admin).await;
    let store = &cloud.store;
    store.invite_vehicle("ann", "car-7").await.unwrap();
    let mut offered = offered(1);
    let plan = json!({ "shares": [5], "success": 95, "failures": 5, "soak_s": 1, "deadline_s": 9,
                       "on_failure": "pause" });
    offered.waves = Some(serde_json::from_value(plan).unwrap());
    store.deploy("ann", &offered).await.unwrap();
    announce(store).await;
    let program = json!({ "version": "1", "pid": 1, "up_s": 1.0, "rss_bytes": 1, "cpu_s": 1.0 });
    let status = json!({
        "vehicle": "car-7", "key": "k", "labels": { "a": "b" }, "orchestrator": program,
        "trust": null, "generation": 1, "deployments": [], "removed": {}, "capacity": [],
        "events_lost": 0, "supervisor": null, "cloud": null,
    });
    store.execute_with("UPDATE vehicles SET status = $1", &[&status.to_string()]).await;
    let code = store.invite("ann", NewUser { name: "bea".to_owned(), role: Role::Viewer }).await;
    let code = json!({ "code": code.unwrap().code }).to_string();
    let mut answers = Vec::new();
    for Endpoint { method, path, gives, .. } in endpoints() {
        let Some("application/json") = gives.map(|it| it.kind) else { continue };
        let body = match (&method, path) {
            (_, "/v1/login") => code.clone(),
            (_, "/v1/vehicles") => json!({ "name": "car-8" }).to_string(),
            (_, "/v1/users") => json!({ "name": "eve", "role": "viewer" }).to_string(),
            (_, "/v1/tokens") => {
                json!({ "name": "nightly", "role": "viewer", "days": 1 }).to_string()
            }
            (_, "/v1/clips/policy") => json!({ "upload": "all", "day_bytes": 1 }).to_string(),
            _ => String::new(),
        };
        let id = if path.starts_with("/v1/clips") { "a@car-7" } else { "brake" };
        let named = path.replace("{name}", "car-7").replace("{id}", id).replace("{change}", "stop");
        let answer = send(&cloud, (method.clone(), &named), Some(&token), &[], body).await;
        // What is signed is tested elsewhere.
        let is_refused =
            (&method, path) == (&Method::POST, "/v1/deployments") || path.ends_with("/envelopes");
        assert_eq!(answer.status.is_success(), !is_refused, "{method} {named}: {}", answer.status);
        let operation = [&*method.as_str().to_ascii_lowercase(), path];
        answers.push(json!([operation, answer.status.as_str(), answer.json()]));
    }
    let file = folder.path().join("answers.json");
    std::fs::write(&file, Value::from(answers).to_string()).unwrap();
    python("-c", &[CHECK, &format!("{DOCS}/fleet.json"), file.to_str().unwrap()]);
}
