//! `fleet`, and `deploy`, `start`, `stop`, `rollback` and `remove` with `--fleet`.

mod refused;

use std::fs;

use gleaner_lambda::manifest::{LambdaKind, Sha256};
use gleaner_protocol::vehicle_api::DeployRequest;
use gleaner_trust::{
    Deployment, Floors, Grants, Labels, Revision, RevisionFile, SecretKey, Verifier, seal, sha256,
    unverified_revision,
};
use serde_json::{Value, json};

use super::CloudUser;
use super::fake::SeenRequest;
use super::vehicles::status;
use crate::programs;

const MANIFEST: &str = "lambda = { name = 'brake', version = '0.2.0', kind = 'python', entry = 'main.py' }\nschedule.period = '1s'\n";

const INPUT: &str = "input = [{ name = 'imu', topic = '/imu', type = 'sensor_msgs/msg/Imu' }]\n";

const DEPLOY: [&str; 5] = ["deploy", "brake", "--fleet", "--key", "key.pem"];

impl CloudUser {
    /// A user who has logged in and published the lambda `brake`.
    fn with_lambda() -> Self {
        let user = Self::logged_in();
        fs::create_dir(user.path("brake")).unwrap();
        fs::write(user.path("brake/lambda.toml"), MANIFEST).unwrap();
        fs::write(user.path("brake/main.py"), "x = 0\n").unwrap();
        user.done(&["keys", "new", "key.pem"]);
        user.done(&["build", "brake"]);
        user.done(&["publish", "brake", "--key", "key.pem"]);
        user.cloud.answers("GET /v1/deployments", &[(200, list(json!([])))]);
        user.cloud.answers("POST /v1/deployments", &[(200, accepted())]);
        user.reports(&[]);
        user.cloud.seen();
        user
    }

    /// Sets the releases that vehicles have reported.
    fn reports(&self, reported: &[(&str, u64)]) {
        let reported = reported.iter().map(|(name, it)| json!({ "vehicle": name, "release": it }));
        let reported = (200, reported.collect());
        self.cloud.answers("GET /v1/deployments/brake/reported", &[reported]);
    }

    /// Sets the release that the cloud has, which the deployer of this key has signed, and the
    /// release of its revision: version 0.1.0, with the rights that its manifest asks for and one
    /// more. Returns the digest of its revision.
    fn has_former(&self, (release, revision): (u64, u64), key: &str) -> Sha256 {
        let manifest = MANIFEST.replace("0.2.0", "0.1.0") + INPUT;
        let revision = Revision {
            name: "brake".parse().unwrap(),
            version: "0.1.0".parse().unwrap(),
            kind: LambdaKind::Python,
            release: revision,
            created: 1,
            files: vec![RevisionFile {
                path: "lambda.toml".parse().unwrap(),
                bytes: manifest.len() as u64,
                sha256: sha256(manifest.as_bytes()),
            }],
        };
        let key = SecretKey::load(&self.path(key)).unwrap();
        let text = |envelope: Vec<u8>| String::from_utf8(envelope).unwrap();
        let envelope = text(seal(&revision, &[&key]).unwrap());
        let (_, digest) = unverified_revision(envelope.as_bytes()).unwrap();
        let deployment = Deployment {
            id: "brake".parse().unwrap(),
            release,
            selector: Labels::new(),
            revision: digest.clone(),
            fallback: None,
            config: Default::default(),
            grants: Grants {
                topics: vec!["/cabin".parse().unwrap(), "/imu".parse().unwrap()],
                ..Grants::default()
            },
            created: 1,
            expires: 2,
        };
        let parts = json!({
            "deployment": text(seal(&deployment, &[&key]).unwrap()),
            "revisions": [{ "envelope": envelope, "manifest": manifest }],
        });
        self.cloud.answers("GET /v1/deployments", &[(200, list(json!([in_cloud(release)])))]);
        self.cloud.answers("GET /v1/deployments/brake/envelopes", &[(200, parts)]);
        digest
    }

    fn vehicles(&self, vehicles: &[(&str, &str, Value)]) {
        let vehicles = vehicles.iter().map(|(name, state, labels)| {
            json!({
                "name": name, "labels": labels, "state": state, "seen": 1, "version": "1",
                "wanted": 3, "handled": 3, "problems": [], "running": 0, "deployments": 1,
            })
        });
        self.cloud.answers("GET /v1/vehicles", &[(200, list(vehicles.collect()))]);
    }

    /// Sets the statuses of a vehicle, in turn: one for each value.
    fn statuses(&self, vehicle: &str, deployments: &[Value]) {
        let statuses = deployments.iter().map(|it| (200, status(std::slice::from_ref(it))));
        let line = format!("GET /v1/vehicles/{vehicle}/status");
        self.cloud.answers(&line, &statuses.collect::<Vec<_>>());
    }

    /// Returns the deployment that was sent last, as a vehicle that trusts the key.
    fn sent(&self) -> Deployment {
        let root = programs::trusting(&self.done(&["keys", "show", "key.pem", "--json"]));
        let labels = Labels::from([("site".parse().unwrap(), "berlin".to_owned())]);
        let floors = Floors::default();
        let vehicle =
            Verifier { root: &root, floors: &floors, labels: &labels, now: 0, known: &[] };
        let seen = self.cloud.seen();
        let request = seen.iter().rfind(|it| it.line == "POST /v1/deployments").unwrap();
        let request: DeployRequest = serde_json::from_slice(&request.body).unwrap();
        vehicle.deployment(request.deployment.as_bytes()).unwrap().payload().clone()
    }
}

fn list(items: Value) -> Value {
    json!({ "items": items })
}

fn accepted() -> Value {
    json!({ "result": "accepted", "id": "brake", "attempt": 0, "generation": 3 })
}

pub fn on_vehicle(release: u64, phase: &str) -> Value {
    json!({
        "id": "brake", "release": release, "envelope": "$sent", "attempt": 5, "lambda": "brake",
        "revision": { "digest": "new", "version": "0.2.0", "release": 1 },
        "fallback": null, "grants": { "topics": [], "models": [], "record": false },
        "is_wanted": true, "runs_fallback": false, "is_proven": false,
        "status": {
            "id": "brake", "name": "brake", "revision": "new", "attempt": 5, "phase": phase,
            "phase_s": 1.0, "restarts": 0, "last_end": "exit code 1", "layers": [],
        },
    })
}

/// The deployment on a vehicle, with another envelope than the one that was sent.
fn other_on_vehicle(release: u64, phase: &str) -> Value {
    let mut deployment = on_vehicle(release, phase);
    deployment["envelope"] = json!("other");
    deployment
}

fn in_cloud(release: u64) -> Value {
    json!({
        "id": "brake", "release": release, "envelope": "$sent", "version": "v",
        "revision": "b".repeat(64),
        "fallback": "a".repeat(64),
        "grants": { "topics": ["/imu"], "models": [], "record": true },
        "selector": { "site": "berlin" }, "is_wanted": true, "vehicles": 2, "running": 1,
        "failed": 0,
    })
}

/// The answer with a status of a vehicle whose supervisor has no lambda.
fn ended(deployments: &[Value]) -> (u16, Value) {
    let mut status = status(deployments);
    status["supervisor"] = json!({
        "generation": 1, "up_s": 1.0, "lambdas": [], "clips": 0, "events_lost": 0,
        "ingress": { "is_ready": true, "restarts": 0 },
    });
    (200, status)
}

#[test]
fn a_deployment_to_a_fleet_sends_missing_files_and_waits_for_each_vehicle() {
    let user = CloudUser::with_lambda();
    let former = user.has_former((6, 1), "key.pem");
    let main = "x = 0\n";
    let digest = gleaner_base::hex(&<sha2::Sha256 as sha2::Digest>::digest(main));
    let missing = json!({
        "result": "missing", "objects": [{ "sha256": digest, "bytes": main.len() }],
    });
    user.cloud.answers("POST /v1/deployments", &[(200, missing), (200, accepted())]);
    let object = format!("PUT /v1/objects/{digest}");
    user.cloud.answers(&object, &[(204, json!(null))]);
    let berlin = || json!({ "site": "berlin" });
    user.vehicles(&[
        ("car-7", "online", berlin()),
        ("car-8", "online", json!({ "site": "paris" })),
        ("car-9", "online", berlin()),
        ("new", "invited", json!({})),
        ("stolen", "revoked", berlin()),
    ]);
    let running = on_vehicle(7, "running");
    user.statuses("car-7", std::slice::from_ref(&running));
    user.statuses("car-9", &[other_on_vehicle(7, "running"), on_vehicle(7, "starting"), running]);
    let arguments = [&DEPLOY[..], &["--selector", "site=berlin"]].concat();
    let text = user.done(&arguments);
    assert_eq!(
        text,
        "fallback: brake 0.1.0 (release 1)\ngrants no longer: topic /cabin\n\
         `brake` is updated on 2 vehicles: car-7, car-9\n\
         deployed brake 0.2.0 as `brake` (release 7, 1 file sent)\n\
         car-7: runs 0.2.0\ncar-9: runs 0.2.0\n`brake` runs on 2 vehicles\n"
    );
    let seen = user.cloud.seen();
    assert_eq!(seen.iter().find(|it| it.line == object).unwrap().body, main.as_bytes());
    let count = |line: &str| seen.iter().filter(|it| it.line == line).count();
    assert_eq!(count("GET /v1/vehicles/car-7/status"), 1);
    assert_eq!(count("GET /v1/vehicles/car-9/status"), 3);
    let json = user.done(&[&arguments[..], &["--json"]].concat());
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["vehicles"][1]["state"], "done", "{json}");
    let sent = user.sent();
    assert_eq!((sent.release, sent.selector.len()), (7, 1));
    // Of what the cloud states, nothing is signed: only what the manifest of the fallback asks for.
    assert_eq!(sent.fallback, Some(former));
    let topics: Vec<_> = sent.grants.topics.iter().map(ToString::to_string).collect();
    assert_eq!((topics, sent.grants.record), (vec!["/imu".to_owned()], false));
    // One that failed on one of two vehicles is a fallback, and one that failed on both is none.
    let none = "none, as the one before failed on 2 vehicles and has none\n";
    for (failed, fallback) in [(1, "brake 0.1.0 (release 1)\n"), (2, none)] {
        let mut stored = in_cloud(6);
        stored["failed"] = json!(failed);
        user.cloud.answers("GET /v1/deployments", &[(200, list(json!([stored])))]);
        let text = user.done(&arguments);
        assert!(text.starts_with(&format!("fallback: {fallback}")), "{text}");
    }
    assert_eq!(user.sent().fallback, None);
}

#[test]
fn what_no_key_of_the_deployer_signed_is_no_part_of_the_next_signature() {
    let user = CloudUser::with_lambda();
    user.vehicles(&[("car-7", "online", json!({ "site": "berlin" }))]);
    user.statuses("car-7", &[on_vehicle(7, "running")]);
    user.done(&["keys", "new", "stranger.pem"]);
    user.has_former((6, 1), "stranger.pem");
    let text = user.fails(3, &DEPLOY);
    assert!(text.contains("the deployment before this one cannot be verified"), "{text}");
    assert!(text.contains("--trust FILE"), "{text}");
    // By hand, or with the trust root that has the other deployer.
    let chosen = [&DEPLOY[..], &["--release", "7", "--fallback", "none"]].concat();
    user.done(&chosen);
    assert!(user.sent().fallback.is_none());
    let keys = ["--publisher", "key.pem", "--deployer", "stranger.pem", "--root", "key.pem"];
    user.done(&[&["trust", "new", "root.json"][..], &keys].concat());
    user.done(&[&DEPLOY[..], &["--trust", "root.json"]].concat());
    let sent = user.sent();
    assert!(sent.fallback.is_some() && sent.release == 7);
    // Another manifest than the signed one, which asks for more.
    let line = "GET /v1/deployments/brake/envelopes";
    user.has_former((6, 1), "key.pem");
    let mut parts = user.cloud.answer(line);
    parts["revisions"][0]["manifest"] = json!(MANIFEST.to_owned() + INPUT);
    user.cloud.answers(line, &[(200, parts)]);
    let text = user.fails(3, &DEPLOY);
    assert!(text.contains("another manifest than that of revision"), "{text}");
    // One of the same deployer for another id, and none that can be fetched.
    let id = ["--id", "other"];
    user.has_former((6, 1), "key.pem");
    for change in ["/envelopes", "/reported"] {
        let answer = match change {
            "/envelopes" => user.cloud.answer(line),
            _ => json!([]),
        };
        user.cloud.answers(&format!("GET /v1/deployments/other{change}"), &[(200, answer)]);
    }
    let mut other = in_cloud(6);
    other["id"] = json!("other");
    user.cloud.answers("GET /v1/deployments", &[(200, list(json!([other])))]);
    let text = user.fails(3, &[&DEPLOY[..], &id].concat());
    assert!(text.contains("is of another id: `brake`"), "{text}");
    user.has_former((6, 1), "key.pem");
    user.cloud.answers(line, &[(500, super::fake::problem(1, "damaged"))]);
    user.fails(1, &DEPLOY);
    user.done(&chosen);
}

#[test]
fn a_change_that_takes_something_away_is_asked_for() {
    let user = CloudUser::with_lambda();
    user.has_former((6, 1), "key.pem");
    user.vehicles(&[
        ("car-7", "online", json!({ "site": "berlin" })),
        ("car-8", "online", json!({ "site": "paris" })),
    ]);
    let moved = [&DEPLOY[..], &["--label", "site=paris"]].concat();
    let text = user.fails(2, &moved);
    assert!(text.contains("`brake` is removed from 1 vehicle: car-7"), "{text}");
    let text = user.fails(2, &["stop", "brake", "--fleet"]);
    assert!(text.contains("`brake` stops on 1 vehicle: car-7"), "{text}");
    let text = user.fails(2, &[&DEPLOY[..], &["--label", "site=parise"]].concat());
    assert!(text.contains("`brake` is removed from 1 vehicle: car-7"), "{text}");
    // Vehicles that have an older release lose it, too.
    let mut several = in_cloud(6);
    several["older_selectors"] = json!([{ "site": "paris" }]);
    user.cloud.answers("GET /v1/deployments", &[(200, list(json!([several])))]);
    let text = user.fails(2, &["remove", "brake", "--fleet"]);
    assert!(text.contains("`brake` is removed from 2 vehicles: car-7, car-8"), "{text}");
    user.has_former((6, 1), "key.pem");
    let changes = |it: &SeenRequest| !it.line.starts_with("GET ");
    assert!(!user.cloud.seen().iter().any(changes), "nothing was sent");
    // The vehicle that loses it is waited for, too.
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[ended(&[on_vehicle(6, "running")])]);
    user.statuses("car-8", &[on_vehicle(7, "running")]);
    let accepted = [&moved[..], &["--yes"]].concat();
    let text = user.fails(4, &[&accepted[..], &["--timeout", "1ms"]].concat());
    assert!(text.contains("car-7: has not applied the change yet"), "{text}");
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[ended(&[])]);
    assert!(user.done(&accepted).contains("car-7: is removed\n"));
}

#[test]
fn the_error_of_a_fleet_names_each_vehicle_and_its_reason() {
    let user = CloudUser::with_lambda();
    user.vehicles(&[
        ("car-7", "online", json!({})),
        ("car-8", "online", json!({})),
        ("car-9", "offline", json!({})),
    ]);
    user.statuses("car-7", &[on_vehicle(1, "running")]);
    user.statuses("car-8", &[on_vehicle(1, "quarantined")]);
    user.statuses("car-9", &[other_on_vehicle(1, "running")]);
    let arguments = [&DEPLOY[..], &["--timeout", "1ms", "--release", "1"]].concat();
    let text = user.fails(6, &arguments);
    assert!(text.starts_with("error: `brake` runs on 1 of 3 vehicles\n"), "{text}");
    for part in ["car-8: does not run, and", "exit code 1", "car-9: offline, seen "] {
        assert!(text.contains(part), "{text}");
    }
    user.statuses("car-8", &[on_vehicle(1, "starting")]);
    let text = user.fails(4, &arguments);
    assert!(text.contains("car-8: its lambda is starting"), "{text}");
}

#[test]
fn a_deployment_without_a_vehicle_yet_is_no_error() {
    let user = CloudUser::with_lambda();
    user.vehicles(&[("car-8", "online", json!({ "site": "paris" }))]);
    let text = user.fails(4, &[&DEPLOY[..], &["--label", "site=berln"]].concat());
    assert!(text.contains("no vehicle matches") && text.contains("site=berln"), "{text}");
    let text = user.done(&[&DEPLOY[..], &["--label", "site=berlin", "--yes"]].concat());
    assert!(text.contains("no vehicle matches the labels yet"), "{text}");
    assert_eq!(user.sent().release, 1);
}

#[test]
fn a_release_that_vehicles_would_refuse_is_not_signed_unless_it_is_named() {
    let user = CloudUser::with_lambda();
    user.vehicles(&[("car-7", "online", json!({})), ("car-8", "revoked", json!({}))]);
    user.statuses("car-7", &[on_vehicle(10, "running")]);
    // The cloud has no deployment of this name, and a vehicle had one. It may be any number. That
    // of a vehicle that does not get it does not count.
    for reported in [9, u64::MAX] {
        user.reports(&[("car-8", u64::MAX), ("car-7", reported)]);
        let text = user.fails(3, &DEPLOY);
        assert!(text.contains("this would be release 1 of `brake`"), "{text}");
        assert!(text.contains(&format!("car-7 reports release {reported}")), "{text}");
    }
    user.done(&[&DEPLOY[..], &["--release", "10"]].concat());
    assert_eq!(user.sent().release, 10);
}

#[test]
fn a_deployment_of_a_fleet_is_listed_changed_and_removed() {
    let user = CloudUser::logged_in();
    user.cloud.answers("GET /v1/deployments", &[(200, list(json!([in_cloud(6)])))]);
    let text = user.done(&["fleet"]);
    let words: Vec<_> = text.lines().nth(1).unwrap().split_whitespace().collect();
    let row = ["brake", "6", "bbbbbbbbbbbb", "site=berlin", "active", "2", "1", "0"];
    assert_eq!(words, row);
    let mut stored = in_cloud(6);
    stored["envelope"] = json!("");
    stored["on_fallback"] = json!(0);
    assert_eq!(user.json(&["fleet"]), json!([stored]));
    (stored["failed"], stored["on_fallback"]) = (json!(3), json!(2));
    user.cloud.answers("GET /v1/deployments", &[(200, list(json!([stored])))]);
    assert!(user.done(&["fleet"]).ends_with(" 3, of which 2 run the fallback\n"));
    user.cloud.answers("GET /v1/deployments", &[(200, list(json!([in_cloud(6)])))]);
    user.vehicles(&[("car-7", "online", json!({ "site": "berlin" }))]);
    let mut stopped = on_vehicle(6, "running");
    stopped["is_wanted"] = json!(false);
    stopped["status"] = json!(null);
    user.cloud.answers("POST /v1/deployments/brake/stop", &[(200, in_cloud(6))]);
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[ended(&[stopped])]);
    let text = user.done(&["stop", "brake", "--fleet", "--yes"]);
    assert_eq!(
        text,
        "`brake` stops on 1 vehicle: car-7\ncar-7: is stopped\n`brake` is stopped on 1 vehicle\n"
    );
    user.cloud.answers("POST /v1/deployments/brake/start", &[(200, in_cloud(6))]);
    user.statuses("car-7", &[on_vehicle(6, "starting"), on_vehicle(6, "running")]);
    assert!(user.done(&["start", "brake", "--fleet"]).ends_with("`brake` runs on 1 vehicle\n"));
    user.cloud.answers("POST /v1/deployments/brake/rollback", &[(200, in_cloud(6))]);
    let text = user.fails(4, &["rollback", "brake", "--fleet"]);
    assert!(text.contains("car-7: keeps release 6, which has no fallback"), "{text}");
    user.cloud.answers("DELETE /v1/deployments/brake", &[(204, json!(null))]);
    user.cloud.answers("GET /v1/vehicles/car-7/status", &[ended(&[])]);
    assert!(
        user.done(&["remove", "brake", "--fleet", "--yes"]).contains("is removed on 1 vehicle")
    );
    let text = user.fails(2, &["stop", "other", "--fleet", "--yes"]);
    assert!(text.contains("the cloud has no deployment `other`"), "{text}");
}

fn in_waves(release: u64, wave: u64, state: &str, reason: &str) -> Value {
    let mut deployment = in_cloud(release);
    deployment["waves"] = json!({
        "plan": {
            "shares": [5, 50], "success": 90, "failures": 5, "soak_s": 600, "deadline_s": 86_400,
            "on_failure": "pause",
        },
        "wave": wave, "waves": 3, "state": state, "reason": reason, "since": 1, "vehicles": 4,
        "running": 3, "failed": 1,
    });
    deployment
}

#[test]
fn a_deployment_in_waves_sends_its_plan_and_can_be_watched() {
    let user = CloudUser::with_lambda();
    let deployments = |all: &[Value]| {
        user.has_former((6, 1), "key.pem");
        let mut answers = all.iter().map(|it| (200, list(json!([it])))).collect::<Vec<_>>();
        answers.insert(1, (503, super::fake::problem(5, "lost")));
        user.cloud.answers("GET /v1/deployments", &answers);
    };
    user.vehicles(&[("car-7", "online", json!({ "site": "berlin" }))]);
    let waves = ["--wave", "5%", "--canary", "50", "--success", "90%"];
    let deploy = [&DEPLOY[..], &waves].concat();
    deployments(&[in_cloud(6), in_waves(7, 1, "running", "")]);
    let text = user.done(&deploy);
    let expected = "wave 1 of 3; running on 3 of 4 vehicles, 1 failed\n\
                    the next wave opens after 10min once 90 % run it: `gleaner fleet` shows them\n";
    assert!(text.ends_with(expected), "{text}");
    let seen = user.cloud.seen();
    let sent = seen.iter().rfind(|it| it.line == "POST /v1/deployments").unwrap();
    let sent: Value = serde_json::from_slice(&sent.body).unwrap();
    assert_eq!(sent["waves"], in_waves(7, 1, "", "")["waves"]["plan"]);
    // Watched, it waits for the last wave, and then for all vehicles.
    let watch = [&deploy[..], &["--watch"]].concat();
    user.statuses("car-7", &[on_vehicle(7, "running")]);
    deployments(&[in_cloud(6), in_waves(7, 2, "running", ""), in_cloud(7)]);
    let text = user.done(&watch);
    assert!(
        text.contains("wave 2 of 3") && text.ends_with("`brake` runs on 1 vehicle\n"),
        "{text}"
    );
    deployments(&[in_cloud(6), in_waves(7, 1, "paused", "failed on 1 of 4 (car-9: no key)")]);
    let text = user.fails(4, &watch);
    assert!(text.contains("wave 1 of 3 paused: failed on 1 of 4 (car-9: no key)"), "{text}");
    assert!(text.contains("gleaner fleet resume ID"), "{text}");
    let mut newer = in_cloud(8);
    newer["envelope"] = json!("other");
    deployments(&[in_cloud(6), newer]);
    let text = user.fails(4, &watch);
    assert!(
        text.contains("this deployment of `brake` was replaced or removed meanwhile"),
        "{text}"
    );
    for (options, reason) in
        [(&["--success", "90%"][..], "--wave"), (&["--wave", "101%"], "`101%` is not a percentage")]
    {
        let text = programs::output(&mut user.command(&[&DEPLOY[..], options].concat()));
        assert_eq!(text.status.code(), Some(2));
        let text = String::from_utf8(text.stderr).unwrap();
        assert!(text.contains(reason), "{text}");
    }
}

#[test]
fn waves_are_listed_paused_resumed_and_aborted() {
    let user = CloudUser::logged_in();
    let paused = in_waves(6, 2, "paused", "by ada");
    let line = "brake: wave 2 of 3 paused by ada; running on 3 of 4 vehicles, 1 failed\n";
    user.cloud.answers("GET /v1/deployments", &[(200, list(json!([paused])))]);
    assert!(user.done(&["fleet"]).ends_with(line));
    for change in ["pause", "resume", "abort"] {
        let request = format!("POST /v1/deployments/brake/{change}");
        user.cloud.answers(&request, &[(200, paused.clone())]);
        assert_eq!(user.done(&["fleet", change, "brake"]), line);
    }
}
