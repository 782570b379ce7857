//! A cloud with a few vehicles that are not real, for tests of its page in a browser and for a look
//! at it: `page_fleet [DIR]`. It prints one line of JSON with the address and a code, and ends with
//! its standard input.

mod fake_clips;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use gleaner_cloud::{CloudServer, ServeOptions};
use gleaner_fleet::{Body, Desired, Ping, Records, Reported, Wanted, WantedProblem, compress};
use gleaner_protocol::supervision::{LambdaPhase, LambdaStatus, ProcessStatus, SupervisorStatus};
use gleaner_protocol::vehicle_api::{DeploymentStatus, RevisionStatus, VehicleStatus};
use gleaner_protocol::{DurationStats, Layer, LiveStatus, LiveTopic};
use gleaner_test_support::cloud::fake::{FakeLink, FakeVehicle, Person, Signed};
use hyper::{Method, StatusCode};
use serde_json::{Value, json};
use tokio::time::{MissedTickBehavior, interval};

/// A text that must not become markup, and must not break the layout.
const HOSTILE: &str = "</div><script>document.title='x'</script><img src=x onerror=alert(1)> \
                       \u{1b}[31mred\u{202e}txt.exe\0 WWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWW";

#[tokio::main]
async fn main() {
    let temporary = tempfile::tempdir().unwrap();
    let data = std::env::args_os().nth(1).map(PathBuf::from);
    let data = data.unwrap_or_else(|| temporary.path().join("data"));
    let server = CloudServer::start(&ServeOptions::local(data)).await.unwrap();
    let admin = Person::login(server.people, server.code.as_ref().unwrap()).await;
    for (name, site, is_hostile) in
        [("car-1", "berlin", false), ("car-2", "berlin", false), ("truck-1", "ulm", true)]
    {
        let (vehicle, _) = admin.enrol(name).await;
        let labels = [("fleet", "test"), ("site", site)];
        let mut labels: BTreeMap<_, _> = labels.map(|(a, b)| (a.into(), b.into())).into();
        if is_hostile {
            labels.insert("note".to_owned(), HOSTILE.to_owned());
        }
        tokio::spawn(drive(vehicle, name, labels, is_hostile));
    }
    admin.call(Method::POST, "/v1/vehicles", json!({ "name": "car-3" })).await;
    let fallback = Signed::new("hard-brake", 1, None, 0);
    let newest = Signed::new("hard-brake", 2, Some(&fallback), 0);
    for signed in [Signed::new("brake-dark", 1, None, 0), fallback, newest] {
        admin.deploy(&signed).await;
    }
    let invited = json!({ "name": "ann", "role": "admin" });
    let invitation = admin.call(Method::POST, "/v1/users", invited).await;
    let address = format!("http://{}", server.people);
    println!("{}", json!({ "address": address, "code": invitation["code"] }));
    let end = || std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
    tokio::task::spawn_blocking(end).await.unwrap().unwrap();
    server.stop().await;
}

/// Follows the cloud as a vehicle would: it reports what it should run as running, and sends
/// records, until it is revoked.
async fn drive(
    vehicle: FakeVehicle,
    name: &'static str,
    labels: BTreeMap<String, String>,
    is_hostile: bool,
) {
    let (mut link, _, mut wanted) = vehicle.connect().await;
    if name != "car-2" {
        fake_clips::announce(&vehicle, is_hostile.then_some(HOSTILE)).await;
    }
    report(&mut link, name, &labels, &wanted, &vehicle, is_hostile).await;
    let mut ticks = interval(Duration::from_millis(500));
    // Two records at one time would look like one that came twice.
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut seq = 0;
    loop {
        tokio::select! {
            body = link.next() => match body {
                Some(Body::Desired(desired)) => {
                    wanted = desired;
                    fake_clips::send_wanted(&vehicle).await;
                    report(&mut link, name, &labels, &wanted, &vehicle, is_hostile).await;
                }
                Some(_) => {}
                None => return,
            },
            _ = ticks.tick() => {
                link.send(Body::Ping(Ping { number: seq })).await;
                let is_run = |it: &Wanted| it.id == "brake-dark" && it.is_wanted;
                let runs = wanted.deployments.iter().any(is_run);
                if name != "car-2" && runs {
                    records(&mut link, seq, is_hostile).await;
                    seq += 1;
                }
            }
        }
    }
}

async fn records(link: &mut FakeLink, seq: u64, is_hostile: bool) {
    let message = match is_hostile {
        true => HOSTILE.to_owned(),
        false => format!("brightness {}", seq % 7),
    };
    let log = json!({ "at_ns": 1, "level": "info", "message": message });
    let trigger = json!({ "kind": "event", "label": "hard-brake", "score": 0.9123,
                          "attributes": { "speed_ms": 13.9 } });
    let decision = json!({ "at_ns": 1, "cause": "tick", "input": null, "topic": null,
                           "writer": null, "seq": null, "triggers": [trigger], "fault": null,
                           "fuel": 1, "run_ns": 1 });
    let event = json!({ "event": "ready", "lambda": "brake-dark", "text": "it is ready" });
    let (kind, record) = if seq % 5 == 4 { ("decision", decision) } else { ("log", log) };
    send(link, "lambdas/brake-dark", "brake-dark", seq, kind, record).await;
    if seq == 0 {
        send(link, "events", "events", 0, "event", event).await;
    }
}

async fn send(link: &mut FakeLink, stream: &str, name: &str, seq: u64, kind: &str, record: Value) {
    let now = std::time::UNIX_EPOCH.elapsed().unwrap().as_nanos() as u64;
    let line = json!({ "stream": name, "seq": seq, "time_ns": now, "boot_ns": seq, "boot": "b",
                       "kind": kind, "record": record });
    let lines = compress(format!("{line}\n").as_bytes());
    let records = Records { stream: stream.to_owned(), life: 1, next: seq + 1, lines };
    link.send(Body::Records(records)).await;
}

async fn report(
    link: &mut FakeLink,
    name: &str,
    labels: &BTreeMap<String, String>,
    desired: &Desired,
    vehicle: &FakeVehicle,
    is_hostile: bool,
) {
    let program = json!({ "version": "0.1.0", "pid": 1, "up_s": 7300.0, "rss_bytes": 21_000_000,
                          "cpu_s": 31.0 });
    let capacity = json!([
        { "resource": "memory", "unit": "B", "asked": 3.1e8, "used": 1.9e8, "most": 1e9,
          "source": "" },
        { "resource": "cpu", "unit": "cores", "asked": 2.5, "most": 2.0, "source": "" },
    ]);
    let status = json!({
        "vehicle": name, "key": "k", "labels": labels, "orchestrator": program,
        "trust": { "version": 3, "expires": 1_900_000_000u64, "is_expired": false },
        "generation": 1, "deployments": [], "capacity": capacity, "supervisor": null,
    });
    let mut status: VehicleStatus = serde_json::from_value(status).unwrap();
    let ingress = ProcessStatus { is_ready: true, ..ProcessStatus::default() };
    status.supervisor =
        Some(SupervisorStatus { ingress, up_s: 7300.0, clips: 12, ..SupervisorStatus::default() });
    for wanted in &desired.deployments {
        status.deployments.extend(deployment(vehicle, wanted, is_hostile).await);
    }
    let generation = desired.generation;
    let status = compress(&serde_json::to_vec(&status).unwrap());
    let text = || HOSTILE.to_owned();
    let hostile = WantedProblem {
        deployment: text(),
        title: text(),
        causes: vec![text()],
        help: text(),
        ..WantedProblem::default()
    };
    let problems = if is_hostile { vec![hostile] } else { Vec::new() };
    link.send(Body::Reported(Reported { generation, status, problems })).await;
}

/// Returns the status of a deployment; `None` if another one has replaced it meanwhile. A hostile
/// vehicle refuses all but one.
async fn deployment(
    vehicle: &FakeVehicle,
    wanted: &Wanted,
    is_hostile: bool,
) -> Option<DeploymentStatus> {
    let (status, envelope) = vehicle.get(&format!("/v1/deployments/{}", wanted.envelope)).await;
    if status == StatusCode::NOT_FOUND {
        return None;
    }
    let signed = gleaner_trust::unverified_deployment(&envelope).unwrap();
    let digest = signed.revision.to_string();
    let is_refused = is_hostile && wanted.id != "brake-dark";
    Some(DeploymentStatus {
        id: wanted.id.clone(),
        release: signed.release,
        envelope: wanted.envelope.clone(),
        attempt: 1,
        lambda: wanted.id.clone(),
        revision: RevisionStatus { digest: digest.clone(), version: "1.0.0".into(), release: 1 },
        is_wanted: wanted.is_wanted,
        is_proven: true,
        refused: is_refused.then(|| HOSTILE.to_owned()),
        status: (wanted.is_wanted && !is_refused).then(|| lambda(&wanted.id, digest)),
        ..DeploymentStatus::default()
    })
}

fn lambda(id: &str, revision: String) -> LambdaStatus {
    let kind = serde_json::from_value(json!("wasm")).unwrap();
    let mut live = LiveStatus::new(id, "1.0.0", kind, PathBuf::new());
    let stats = |p50_ns, p99_ns, max_ns| Some(DurationStats { n: 50, p50_ns, p99_ns, max_ns });
    (live.wakes, live.triggers, live.skipped, live.rss_bytes) = (73_012, 41, 3, 31_000_000);
    live.wake_latency = stats(41_000, 180_000, 2_100_000);
    live.run_time = stats(350_000, 1_900_000, 8_800_000);
    live.decision_latency = stats(8_000, 21_000, 90_000);
    live.topics = vec![LiveTopic {
        name: "imu".into(),
        topic: "/vehicle/imu".into(),
        type_name: "sensor_msgs/msg/Imu".into(),
        writers: Some(1),
        rate_hz: 100.0,
        received: 730_000,
        lost: Some(2),
        age_ns: Some(4_100_000),
        ..LiveTopic::default()
    }];
    LambdaStatus {
        id: id.to_owned(),
        name: id.to_owned(),
        revision,
        attempt: 1,
        phase: LambdaPhase::Running,
        phase_s: 7290.0,
        pid: Some(7),
        live: Some(Box::new(live)),
        layers: vec![
            Layer::yes("files", "landlock: only the build folder"),
            Layer::yes("processes", "own namespace"),
            Layer::partly("memory", "no control group: the address space is limited"),
            Layer::no("devices", "the kernel has no filter"),
        ],
        ..LambdaStatus::default()
    }
}
