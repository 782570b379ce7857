//! Deployments that a vehicle refuses, and files that were changed after they were accepted.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;

use gleaner_protocol::supervision::{EventKind, LambdaPhase};
use gleaner_tests::denied::without;
use gleaner_tests::vehicle::{TestVehicle, text};

use super::{PythonLambda, events, files, ticker};

pub fn signatures() {
    let mut vehicle = TestVehicle::new();
    fs::write(vehicle.path("vehicle.toml"), "[vehicle]\nlabels = { site = \"berlin\" }\n")
        .expect("the folder can be written");
    vehicle.start();
    let lambda = ticker("rust", "ticker");
    let path = lambda.path().to_str().expect("a plain path");
    let [deployer, stranger] = ["deployer", "stranger"].map(|key| vehicle.key(key));
    let deploy = |key: &str, args: &[&str]| {
        text(&vehicle.gleaner(&[&["deploy", "--local", path, "--key", key], args].concat()))
    };
    let refused = |said: &str, words: &str| {
        assert!(said.contains("exit status: 3") && said.contains(words), "{said}");
    };
    vehicle.publish(lambda.path(), "stranger");
    refused(&deploy(&deployer, &[]), "the revision is signed by");
    fs::remove_file(lambda.path().join("revision.json")).expect("it was written");
    vehicle.publish(lambda.path(), "publisher");
    refused(&deploy(&stranger, &[]), "the deployment is signed by");
    refused(&deploy(&deployer, &["--label", "site=paris"]), "`site` = `paris`");
    assert!(vehicle.status().deployments.is_empty());
    let accepted = deploy(&deployer, &["--label", "site=berlin", "--release", "7"]);
    assert!(accepted.contains("running"), "{accepted}");
    refused(&deploy(&deployer, &["--release", "6"]), "7");
    refused(&deploy(&deployer, &["--release", "7", "--expires", "5d"]), "7");
    // What runs is as before.
    assert_eq!(vehicle.deployment("ticker").release, 7);
    assert_eq!(vehicle.deployment("ticker").status.expect("it runs").restarts, 0);
}

/// Its process cannot be sandboxed, as in a container: the machine is at fault.
pub fn layers() {
    let mut vehicle = TestVehicle::new();
    let refused = [
        (libc::SYS_seccomp, "rust", "`system calls` does not hold"),
        // Without it, an interpreter has no bound of memory.
        (libc::SYS_prlimit64, "python", "`needed calls` does not hold; cause: `prlimit64`: "),
    ];
    for (call, kind, expected) in refused {
        let lambda = ticker(kind, kind);
        without(call, || {
            vehicle.start();
            let deployed = text(&vehicle.deploy(lambda.path(), &["--timeout", "1s"]));
            assert!(!deployed.contains("repair the lambda"), "{deployed}");
            // More starts than an end before it is ready would be forgiven.
            let status = vehicle.until("further starts", |vehicle| {
                vehicle.deployment(kind).status.filter(|status| status.restarts > 3)
            });
            assert_ne!(status.phase, LambdaPhase::Quarantined);
            let reason = gleaner_base::in_one_line(&status.last_end.unwrap_or_default());
            assert!(reason.contains(expected), "{reason}");
            let shown = text(&vehicle.gleaner(&["status"]));
            assert!(shown.contains(expected), "{shown}");
            vehicle.stop();
        });
    }
    vehicle.start();
    vehicle.until_running(&["rust", "python"]);
}

pub fn changed_file() {
    let mut vehicle = TestVehicle::started();
    let lambda = ticker("python", "ticker");
    vehicle.deploy(lambda.path(), &[]);
    let revision = files(&vehicle.path("state/revisions")).remove(0);
    let code = revision.join("build/main.py");
    let mut changed = fs::read(&code).expect("it is stored");
    changed.extend(b"# more\n");
    fs::set_permissions(&code, fs::Permissions::from_mode(0o600)).expect("our file");
    fs::write(&code, changed).expect("our file");
    let runtime = vehicle.processes("start.py")[0];
    gleaner_tests::live::signal(runtime, "KILL");
    let status = vehicle.until("the refusal", |vehicle| {
        let status = vehicle.deployment("ticker").status?;
        (status.phase == LambdaPhase::Quarantined).then_some(status)
    });
    let reason = status.last_end.unwrap_or_default();
    assert!(reason.contains("its files are refused") && reason.contains("main.py"), "{reason}");
    // The daemon does not start it either.
    vehicle.stop();
    vehicle.start();
    vehicle.until("the refusal", |vehicle| {
        let status = vehicle.deployment("ticker").status?;
        (status.phase == LambdaPhase::Quarantined).then_some(())
    });
    assert!(vehicle.processes("start.py").is_empty());
    // Its deployment brings the file back; the others are still there.
    let deployed = text(&vehicle.deploy(lambda.path(), &[]));
    assert!(deployed.contains("1 file sent") && deployed.contains("running"), "{deployed}");
}

pub fn lost_state() {
    let mut vehicle = TestVehicle::started();
    let lambda = ticker("rust", "ticker");
    vehicle.deploys(lambda.path());
    vehicle.stop();
    let copies = ["state/state.json", "state/state.json.copy"].map(|name| vehicle.path(name));
    let backup = fs::read(&copies[0]).expect("it is durable");
    copies.iter().for_each(|copy| fs::remove_file(copy).expect("it is there"));
    vehicle.start();
    vehicle.until("a status", |vehicle| vehicle.try_status()?.supervisor);
    assert!(vehicle.status().deployments.is_empty());
    let warnings = events(&vehicle, EventKind::Warning);
    let is_named = |text: &String| text.contains("state.json` and its copy are missing");
    assert!(warnings.iter().any(is_named), "{warnings:?}");
    assert_eq!(files(&vehicle.path("state/revisions")).len(), 1);
    vehicle.stop();
    copies.iter().for_each(|copy| fs::write(copy, &backup).expect("our folder"));
    vehicle.start();
    vehicle.until_running(&["ticker"]);
}

pub fn retried() {
    let mut vehicle = TestVehicle::started();
    let lambda = ticker("rust", "ticker");
    vehicle.deploys(lambda.path());
    vehicle.stop();
    // In place of a disk that fails, or a machine without memory or open files.
    let revision = files(&vehicle.path("state/revisions")).remove(0);
    let hidden = vehicle.path("hidden");
    fs::rename(&revision, &hidden).expect("our folder");
    vehicle.start();
    let reason = vehicle.deployment("ticker").refused.expect("its files cannot be read");
    fs::rename(&hidden, &revision).expect("our folder");
    vehicle.until_running(&["ticker"]);
    let refusals = events(&vehicle, EventKind::Refused);
    assert_eq!(refusals.len(), 1, "{reason}: {refusals:?}");
}

pub fn memory() {
    let mut vehicle = TestVehicle::new();
    fs::write(vehicle.path("vehicle.toml"), "[deployments]\nmemory = \"1 GiB\"\n")
        .expect("the folder can be written");
    vehicle.start();
    let [first, second] = ["first", "second"].map(|name| ticker("python", name));
    vehicle.deploys(first.path());
    let refused = text(&vehicle.deploy(second.path(), &[]));
    assert!(refused.contains("there is no memory for deployment `second`"), "{refused}");
    let numbers =
        "it asks for 608 MiB, the other deployments for 608 MiB, and all may ask for 1 GiB";
    assert!(refused.contains(numbers), "{refused}");
    // One that is stopped takes none.
    vehicle.succeeds(&["stop", "first"]);
    vehicle.deploys(second.path());
    let refused = text(&vehicle.gleaner(&["start", "first"]));
    assert!(refused.contains("there is no memory for deployment `first`"), "{refused}");
    // What was admitted runs, also if the vehicle has less later.
    vehicle.stop();
    let settings = "[deployments]\nmemory = \"64 MiB\"\n[metrics]\nlisten = \"127.0.0.1:9464\"\n";
    fs::write(vehicle.path("vehicle.toml"), settings).expect("the folder can be written");
    vehicle.start();
    vehicle.until_running(&["second"]);
    let mut metrics = TcpStream::connect("127.0.0.1:9464").expect("it listens");
    let request = b"GET /metrics HTTP/1.1\r\nhost: here\r\nconnection: close\r\n\r\n";
    metrics.write_all(request).expect("it reads");
    let mut answer = String::new();
    metrics.read_to_string(&mut answer).expect("it answers");
    assert!(answer.contains("gleaner_lambda_up{id=\"second\",lambda=\"second\"} 1"), "{answer}");
    let shown = vehicle.succeeds(&["status"]);
    assert!(shown.contains("memory: 608.0 MiB reserved of 64.0 MiB allowed"), "{shown}");
}

pub fn cpu() {
    let vehicle = TestVehicle::started();
    let other = ticker("rust", "other");
    vehicle.deploys(other.path());
    let greedy = PythonLambda::new("greedy", "def on_tick(self, ctx):\n    pass");
    greedy.add("[demand]\ncpu = \"1min\"\n");
    let refused = text(&vehicle.deploy(greedy.path(), &[]));
    for words in [
        "exit status: 3",
        "there is no CPU time for deployment `greedy`",
        "it asks for 600.00 cores, the other deployments for 0.01 cores, and all may ask for ",
        "its demand is stated: 10 wakes/s of 1min",
        "raise `deployments.cpu` in vehicle.toml",
    ] {
        assert!(refused.contains(words), "{words}: {refused}");
    }
    let status = vehicle.status();
    let ids: Vec<_> = status.deployments.iter().map(|it| it.id.as_str()).collect();
    assert_eq!(ids, ["other"]);
    assert_eq!(vehicle.deployment("other").status.expect("it runs").restarts, 0);
    let demand = &status.deployments[0].demand;
    let cpu = demand.iter().find(|it| it.resource == "cpu").expect("it is listed");
    assert_eq!((cpu.asked, &*cpu.source), (0.01, "assumed: 10 wakes/s of 1 ms"));
    let shown = vehicle.succeeds(&["status"]);
    assert!(shown.contains("cpu: 0.01 cores reserved of "), "{shown}");
    // The speed of the machine is measured once, in the background.
    vehicle.until("the speed", |vehicle| {
        let measured = fs::read_to_string(vehicle.path("state/measured.json")).ok()?;
        measured.contains("\"machine\":[").then_some(())
    });
}
