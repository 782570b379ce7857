//! A vehicle and a cloud, with real programs on both sides.

use std::collections::BTreeSet;

use gleaner_fleet::clips::{ClipState, FleetClip};
use gleaner_fleet::people::VehicleState;
use gleaner_protocol::supervision::LambdaPhase;
use gleaner_protocol::vehicle_api::StreamLine;
use gleaner_tests::LambdaCopy;
use gleaner_tests::cloud::TestCloud;
use gleaner_tests::vehicle::{TestVehicle, text};

use super::{recording, ticker};

const NAME: &str = "car-7";

fn enrolled() -> (TestCloud, TestVehicle) {
    let cloud = TestCloud::new();
    let mut vehicle = TestVehicle::new();
    let labels = "[vehicle]\nname = \"car-7\"\n[vehicle.labels]\ntown = \"oslo\"\n";
    std::fs::write(vehicle.path("vehicle.toml"), labels).expect("a file");
    vehicle.start();
    cloud.enrol(&vehicle, NAME);
    (cloud, vehicle)
}

/// Publishes a lambda, and deploys it in the fleet with further arguments.
fn deploy(
    (cloud, vehicle): (&TestCloud, &TestVehicle),
    lambda: &LambdaCopy,
    key: &str,
    args: &[&str],
) -> std::process::Output {
    let published = vehicle.publish(lambda.path(), "publisher");
    assert!(published.status.success(), "{}", text(&published));
    let folder = lambda.path().to_str().expect("a plain path");
    let key = vehicle.key(key);
    cloud.gleaner(&[&["deploy", folder, "--fleet", "--key", &key], args].concat())
}

fn phase(vehicle: &TestVehicle, id: &str) -> Option<LambdaPhase> {
    let deployments = vehicle.try_status()?.deployments;
    let deployment = deployments.into_iter().find(|it| it.id == id)?;
    deployment.status.map(|lambda| lambda.phase)
}

/// Waits until the cloud has the same events as the vehicle, none of them twice.
fn until_all_events(cloud: &TestCloud, vehicle: &TestVehicle) {
    let key = |line: &StreamLine| (line.stream.clone(), line.seq, line.kind.clone());
    let of = |lines: Vec<StreamLine>| {
        let (all, count): (BTreeSet<_>, _) = (lines.iter().map(key).collect(), lines.len());
        assert_eq!(all.len(), count, "an event is there twice");
        all
    };
    vehicle.until("all events at the cloud", |vehicle| {
        let wanted = of(vehicle.records(None));
        (of(cloud.records(NAME, None)) == wanted).then_some(())
    });
}

pub fn follows() {
    let (cloud, mut vehicle) = enrolled();
    assert!(cloud.vehicle(NAME).state == VehicleState::Online);
    let lambda = ticker("rust", "ticks");
    let other =
        deploy((&cloud, &vehicle), &lambda, "deployer", &["--selector", "town=bergen", "--yes"]);
    assert!(other.status.success() && text(&other).contains("no vehicle"), "{}", text(&other));
    assert_eq!(phase(&vehicle, "ticks"), None, "it is for vehicles elsewhere");
    // The wave has the only vehicle, so that the last one has no others.
    let waves = ["--selector", "town=oslo", "--wave", "50%", "--soak", "1s", "--watch"];
    let deployed = deploy((&cloud, &vehicle), &lambda, "deployer", &waves);
    let shown = text(&deployed);
    assert!(deployed.status.success() && shown.contains("wave 1 of 2"), "{shown}");
    assert_eq!(phase(&vehicle, "ticks"), Some(LambdaPhase::Running));
    let status = cloud.succeeds(&["status", "--on", NAME]);
    assert!(status.contains("ticks"), "{status}");
    // Its decisions have triggers, which are sent as they are made.
    vehicle.until("decisions at the cloud", |_| {
        let lines = cloud.records(NAME, Some("ticks"));
        lines.iter().any(|line| line.kind == "decision").then_some(())
    });
    cloud.succeeds(&["stop", "ticks", "--fleet", "--yes"]);
    vehicle.until("the lambda to stop", |vehicle| {
        (!vehicle.deployment("ticks").is_wanted).then_some(())
    });
    // What is changed at the vehicle stays, also after a restart there.
    vehicle.succeeds(&["start", "ticks"]);
    vehicle.kill_orchestrator();
    vehicle.start();
    vehicle.until("the connection", |vehicle| {
        (vehicle.try_status()?.cloud?.state == "connected").then_some(())
    });
    vehicle.until_running(&["ticks"]);
    let local = ticker("rust", "local");
    vehicle.deploys(local.path());
    cloud.succeeds(&["remove", "ticks", "--fleet", "--yes"]);
    vehicle.until("the removal", |vehicle| {
        let ids = vehicle.status().deployments.into_iter().map(|it| it.id);
        (ids.collect::<Vec<_>>() == ["local"]).then_some(())
    });
    until_all_events(&cloud, &vehicle);
    vehicle.stop();
}

pub fn clips() {
    let (mut cloud, mut vehicle) = enrolled();
    let lambda = recording("rust", "ticks");
    vehicle.deploys(lambda.path());
    vehicle.until("two clips", |vehicle| (super::clips(vehicle).len() > 1).then_some(()));
    // Both sides are killed while clips are announced.
    cloud.kill();
    vehicle.kill_orchestrator();
    assert!(cloud.start().is_none(), "its user is still logged in");
    vehicle.start();
    vehicle.succeeds(&["stop", "ticks"]);
    let listed = |cloud: &TestCloud| -> Vec<FleetClip> {
        let text = cloud.succeeds(&["clips", "--lambda", "ticks", "-n", "10000", "--json"]);
        serde_json::from_str(&text).expect("a list")
    };
    vehicle.until("every clip at the cloud, once", |vehicle| {
        let here = super::clips(vehicle).into_iter().map(|clip| clip.file);
        let here: Vec<_> = here.map(|file| file.display().to_string()).collect();
        let mut there: Vec<_> =
            listed(&cloud).iter().map(|clip| format!("clips/{}.mcap", clip.facts.name)).collect();
        there.reverse();
        (here == there).then_some(())
    });
    let clip = listed(&cloud).pop().expect("there is one");
    let lambda = &clip.facts.lambdas[0];
    assert_eq!((clip.state, lambda.deployment.as_deref()), (ClipState::OnVehicle, Some("ticks")));
    assert!(lambda.revision.is_some() && !clip.facts.moments.is_empty(), "{clip:?}");
    let folder = cloud.path("fetched");
    let to = folder.to_str().expect("a plain path");
    cloud.succeeds(&["clips", "pull", &clip.id.to_string(), "--to", to]);
    let file = folder.join(NAME).join(format!("{}.mcap", clip.facts.name));
    let original = vehicle.path(&format!("state/clips/clips/{}.mcap", clip.facts.name));
    assert!(std::fs::read(&file).expect("it came") == std::fs::read(original).expect("it stays"));
    let trust = cloud.path("vehicles");
    std::fs::write(&trust, format!("{NAME} {}\n", vehicle.status().key)).expect("a file");
    let [file, trust] = [&file, &trust].map(|path| path.to_str().expect("a plain path"));
    let verified = cloud.succeeds(&["verify", file, "--trust", trust]);
    assert!(verified.contains("signed by car-7"), "{verified}");
    // The table of an export names the file that is there already.
    cloud.succeeds(&["clips", "export", "--label", &clip.facts.moments[0].label, "--to", to]);
    let table = std::fs::read_to_string(folder.join("events.jsonl")).expect("a table");
    let row: serde_json::Value =
        serde_json::from_str(table.lines().next().expect("a row")).expect("JSON");
    assert_eq!(row["clip"], format!("{NAME}/{}.mcap", clip.facts.name));
    let again = cloud.gleaner(&["clips", "export", "--to", to]);
    assert!(!again.status.success(), "a table is not replaced");
}

pub fn killed() {
    let (mut cloud, vehicle) = enrolled();
    let lambda = ticker("rust", "ticks");
    let deployed = deploy((&cloud, &vehicle), &lambda, "deployer", &[]);
    assert!(deployed.status.success(), "{}", text(&deployed));
    for round in 0..3 {
        cloud.kill();
        let change = if round % 2 == 0 { "stop" } else { "start" };
        vehicle.succeeds(&[change, "ticks"]);
        assert!(cloud.start().is_none(), "its user is still logged in");
        vehicle.until("the connection", |_| {
            (cloud.vehicle(NAME).state == VehicleState::Online).then_some(())
        });
        until_all_events(&cloud, &vehicle);
    }
    assert_eq!(cloud.vehicle(NAME).problems, []);
}

pub fn refused() {
    let (cloud, vehicle) = enrolled();
    let lambda = ticker("rust", "ticks");
    let deployed = deploy((&cloud, &vehicle), &lambda, "deployer", &[]);
    assert!(deployed.status.success(), "{}", text(&deployed));
    let before = vehicle.deployment("ticks").attempt;
    // The cloud accepts it, as it knows no keys.
    let other = ticker("rust", "other");
    let refused = deploy((&cloud, &vehicle), &other, "stranger", &["--timeout", "20s"]);
    assert!(!refused.status.success(), "{}", text(&refused));
    assert!(text(&refused).contains("the deployment is refused"), "{}", text(&refused));
    assert_eq!(phase(&vehicle, "other"), None);
    let deployment = vehicle.deployment("ticks");
    assert_eq!((deployment.attempt, deployment.is_wanted), (before, true), "it runs on");
    // Its name cannot be used by another vehicle.
    let second = TestVehicle::new();
    let file = cloud.path("car-7.enrolment");
    let again = second.gleaner(&["enrol", file.to_str().expect("a plain path")]);
    assert!(!again.status.success());
    cloud.succeeds(&["vehicles", "revoke", NAME]);
    vehicle
        .until("the refusal", |vehicle| (vehicle.status().cloud?.state == "refused").then_some(()));
    assert_eq!(phase(&vehicle, "ticks"), Some(LambdaPhase::Running), "it runs on without a cloud");
    vehicle.succeeds(&["unenrol"]);
    assert_eq!(vehicle.status().cloud, None);
}

pub fn restored() {
    let (mut cloud, mut vehicle) = enrolled();
    let deploys = |cloud: &TestCloud, vehicle: &TestVehicle, name: &str| {
        let lambda = ticker("rust", name);
        let deployed = deploy((cloud, vehicle), &lambda, "deployer", &[]);
        assert!(deployed.status.success(), "{}", text(&deployed));
    };
    deploys(&cloud, &vehicle, "older");
    cloud.back_up("backup");
    deploys(&cloud, &vehicle, "newer");
    cloud.kill();
    std::fs::remove_dir_all(cloud.path("data")).expect("it is gone");
    std::fs::rename(cloud.path("backup"), cloud.path("data")).expect("it is restored");
    assert!(cloud.start().is_none(), "its user is still logged in");
    vehicle.until("the connection", |_| cloud.vehicle(NAME).is_ahead.then_some(()));
    // Neither what it does not know nor a stop by it takes anything away before.
    let stop = cloud.gleaner(&["stop", "older", "--fleet", "--yes", "--timeout", "5s"]);
    assert!(text(&stop).contains("car-7: it stays on this vehicle"), "{}", text(&stop));
    vehicle.until("what stays, by name", |_| {
        cloud.succeeds(&["vehicles"]).contains("newer: it stays on this vehicle").then_some(())
    });
    for id in ["older", "newer"] {
        assert_eq!(phase(&vehicle, id), Some(LambdaPhase::Running));
    }
    cloud.succeeds(&["vehicles", "agree", NAME]);
    vehicle.until("the removal and the stop", |vehicle| {
        let left: Vec<_> = vehicle.status().deployments;
        (left.len() == 1 && left[0].id == "older" && !left[0].is_wanted).then_some(())
    });
    vehicle.until("no difference", |_| (!cloud.vehicle(NAME).is_ahead).then_some(()));
    until_all_events(&cloud, &vehicle);
    // An image of this vehicle begins with another key, and without an enrolment.
    let key = vehicle.status().key;
    vehicle.succeeds(&["unenrol", "--new-identity"]);
    vehicle.kill_orchestrator();
    vehicle.start();
    let status = vehicle.status();
    assert!(status.key != key && status.cloud.is_none(), "{status:?}");
}
