//! The cloud stops or is killed, and starts again on the same folder.

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use gleaner_cloud::{CloudServer, ServeOptions};
use gleaner_test_support::cloud::fake::{Person, cursor_after, soon};
use gleaner_test_support::cloud::postgres;
use hyper::Method;
use rustix::process::Pid;
use serde_json::Value;
use tempfile::TempDir;
use tokio::time::{Duration, sleep};

use crate::{options, reported, signed, start, start_with_vehicle};

#[tokio::test]
async fn a_restart_keeps_everything() {
    let (folder, server, admin) = start().await;
    let second = CloudServer::start(&options(folder.path()).await).await.err().unwrap();
    assert!(second.message.starts_with("another gleaner-cloud uses"), "{second}");
    let other = TempDir::new().unwrap();
    let stolen = ServeOptions { data: other.path().join("data"), ..options(folder.path()).await };
    if stolen.store.is_some() {
        let third = CloudServer::start(&stolen).await.err().unwrap();
        assert!(third.message.contains("belongs to another data folder"), "{third}");
    }
    let (mut vehicle, _) = admin.enrol("car-7").await;
    let (mut link, _, before) = vehicle.connect().await;
    link.record(0..2).await;
    let envelope = admin.deploy(&signed(1)).await;
    link.send(reported(before.generation)).await;
    assert!(link.next().await.is_some(), "a desired state");
    link.settle().await;
    let listed = admin.call(Method::GET, "/v1/deployments", Value::Null).await;
    server.stop().await;

    let server = CloudServer::start(&options(folder.path()).await).await.unwrap();
    assert_eq!(server.code, None, "an administrator has a token");
    let admin = admin.at(server.people);
    vehicle.address = server.vehicles.to_string();
    assert_eq!(admin.vehicle("car-7").await["state"], "offline");
    assert_eq!(admin.call(Method::GET, "/v1/deployments", Value::Null).await, listed);
    let (_link, welcome, desired) = vehicle.connect().await;
    assert_eq!((welcome.epoch, welcome.cursors), (2, vec![cursor_after(2)]));
    assert_eq!(desired.generation, before.generation + 1, "unchanged by the restart");
    assert_eq!(desired.deployments[0].envelope, envelope);
    server.stop().await;
}

#[tokio::test]
async fn many_records_move_into_files_and_are_read_and_found_as_before() {
    let (folder, server, admin, vehicle) = start_with_vehicle().await;
    let mut link = vehicle.connect().await.0;
    for part in 0..5 {
        link.record(part * 4000..(part + 1) * 4000).await;
    }
    let events = "/v1/vehicles/car-7/events";
    let expected = admin.lines(events).await;
    assert_eq!(expected.len(), 20_000);
    server.stop().await;

    // The next process looks for such records at once.
    let server = CloudServer::start(&options(folder.path()).await).await.unwrap();
    let admin = admin.at(server.people);
    let files = || folder.path().join("data/records").read_dir().unwrap().count();
    soon(async {
        while files() == 0 {
            sleep(Duration::from_millis(50)).await;
        }
    })
    .await;
    assert_eq!(admin.lines(events).await, expected);
    let last = format!("{events}?last=19000");
    assert_eq!(admin.lines(&last).await, expected[1000..]);
    let found = admin.call(Method::GET, "/v1/records?vehicle=car-7&limit=2", Value::Null).await;
    assert_eq!(found["items"][0]["line"]["seq"], 19_999);
    server.stop().await;
}

#[tokio::test]
async fn a_kill_loses_nothing_that_was_acknowledged() {
    let folder = TempDir::new().unwrap();
    let mut program = CloudProgram::start(folder.path()).await;
    let admin = Person::login(program.people, program.code.as_ref().unwrap()).await;
    let (mut vehicle, _) = admin.enrol("car-7").await;
    for round in 0..5 {
        let (mut link, welcome, _) = vehicle.connect().await;
        let expected = (round > 0).then(|| cursor_after(round * 3));
        assert_eq!(welcome.cursors, expected.into_iter().collect::<Vec<_>>());
        for seq in round * 3..round * 3 + 3 {
            link.record(seq..seq + 1).await;
        }
        drop(program);
        program = CloudProgram::start(folder.path()).await;
        vehicle.address = program.vehicles.to_string();
    }
    let admin = admin.at(program.people);
    assert_eq!(admin.lines("/v1/vehicles/car-7/events").await.len(), 15);
    let invited = Command::new(env!("CARGO_BIN_EXE_gleaner-cloud"))
        .args(["invite", "ann", "--role", "viewer", "--data"])
        .arg(folder.path().join("data"))
        .args(store_option(folder.path()).await)
        .output()
        .unwrap();
    let code = String::from_utf8(invited.stdout).unwrap();
    let ann = Person::login(program.people, code.trim()).await;
    assert_eq!(ann.call(Method::GET, "/v1/me", Value::Null).await["role"], "viewer");
    let copy = folder.path().join("copy.db");
    let backup = Command::new(env!("CARGO_BIN_EXE_gleaner-cloud"))
        .arg("backup")
        .arg(&copy)
        .arg("--data")
        .arg(folder.path().join("data"))
        .output()
        .unwrap();
    let message = String::from_utf8(backup.stderr).unwrap();
    match store_option(folder.path()).await.is_empty() {
        true => {
            assert!(backup.status.success(), "{message}");
            assert_eq!(std::fs::metadata(copy).unwrap().permissions().mode() & 0o777, 0o600);
        }
        false => assert!(message.contains("add --store"), "{message}"),
    }
    let pid = Pid::from_child(&program.child);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    assert!(program.child.wait().unwrap().success());
}

/// Returns the arguments that name the database of the tests in a folder.
async fn store_option(folder: &Path) -> Vec<String> {
    let url = postgres::store_of(folder).await;
    url.map_or_else(Vec::new, |url| vec!["--store".to_owned(), url])
}

/// The program, killed when it is dropped.
struct CloudProgram {
    child: Child,
    people: SocketAddr,
    vehicles: SocketAddr,
    code: Option<String>,
}

impl CloudProgram {
    async fn start(folder: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_gleaner-cloud"))
            .args(["serve", "--http", "127.0.0.1:0", "--vehicles", "127.0.0.1:0", "--data"])
            .arg(folder.join("data"))
            .args(store_option(folder).await)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut value = |name: &str| {
            let line = lines.next().unwrap().unwrap();
            line.strip_prefix(name).unwrap().trim().to_owned()
        };
        let people = value("people:").strip_prefix("http://").unwrap().parse().unwrap();
        let vehicles = value("vehicles:").parse().unwrap();
        // The next line is there only without an administrator.
        let is_first = !folder.join("started").exists();
        std::fs::write(folder.join("started"), "").unwrap();
        let code = is_first.then(|| value("first:").rsplit(' ').next().unwrap().to_owned());
        Self { child, people, vehicles, code }
    }
}

impl Drop for CloudProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
