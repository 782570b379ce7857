//! A cloud for tests: its program and its users in folders of its own. It needs a network of its
//! own, as it listens on its usual ports.

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};

use gleaner_fleet::people::VehicleSummary;
use gleaner_protocol::vehicle_api::StreamLine;

use crate::vehicle::{TestVehicle, text};
use crate::{TempFolder, program};

/// The cloud. Dropping it ends the program.
pub struct TestCloud {
    folder: TempFolder,
    server: Option<Child>,
}

impl TestCloud {
    /// Starts a cloud, and logs its first user in.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        let mut cloud = Self { folder: TempFolder::new(), server: None };
        let first = cloud.start().expect("the first start prints a code");
        let code = first.split_whitespace().last().expect("a code").to_owned();
        cloud.succeeds(&["login", "http://127.0.0.1:8080", "--code", &code]);
        cloud
    }

    /// Starts the program, and waits until it serves. Returns the line with the first code, if
    /// there is one.
    pub fn start(&mut self) -> Option<String> {
        let mut command = Command::new(program("gleaner-cloud"));
        command.arg("serve").arg("--data").arg(self.path("data"));
        command.stdin(Stdio::null()).stdout(Stdio::piped());
        let mut server = command.spawn().expect("gleaner-cloud starts");
        let out = BufReader::new(server.stdout.take().expect("it is piped"));
        self.server = Some(server);
        // These two lines come first, and always.
        let lines: Vec<_> = out.lines().map_while(Result::ok).take(2).collect();
        assert!(lines.last().is_some_and(|line| line.starts_with("vehicles:")), "{lines:?}");
        if self.path("config").exists() {
            return None;
        }
        let data = self.path("data");
        let mut invite = Command::new(program("gleaner-cloud"));
        invite.args(["invite", "admin", "--role", "admin", "--data"]).arg(data);
        let output = invite.output().expect("gleaner-cloud starts");
        assert!(output.status.success(), "{}", text(&output));
        Some(String::from_utf8_lossy(&output.stdout).into_owned())
    }

    /// Sends SIGKILL to the program, and waits for its end.
    pub fn kill(&mut self) {
        if let Some(mut server) = self.server.take() {
            let _ = server.kill();
            let _ = server.wait();
        }
    }

    /// Copies its data to the folder `name` while it runs, as docs/cloud-operation.md has it.
    pub fn back_up(&self, name: &str) {
        let (data, copy) = (self.path("data"), self.path(name));
        std::fs::create_dir(&copy).expect("a folder");
        let mut backup = Command::new(program("gleaner-cloud"));
        backup.arg("backup").arg(copy.join("cloud.db")).arg("--data").arg(&data);
        let mut rest = Command::new("cp");
        rest.arg("-r").args(["objects", "clips", "records", "ca"].map(|it| data.join(it)));
        for step in [&mut backup, rest.arg(copy)] {
            let output = step.output().expect("it starts");
            assert!(output.status.success(), "{}", text(&output));
        }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Enrols a vehicle, which runs, under this name.
    pub fn enrol(&self, vehicle: &TestVehicle, name: &str) {
        let file = self.path(&format!("{name}.enrolment"));
        let file = file.to_str().expect("a plain path");
        self.succeeds(&["vehicles", "enrol", name, "--to", file]);
        vehicle.succeeds(&["enrol", file]);
    }

    /// Runs `gleaner` as a user of the cloud.
    pub fn gleaner(&self, args: &[&str]) -> Output {
        let mut gleaner = Command::new(program("gleaner"));
        gleaner.env("XDG_CONFIG_HOME", self.path("config")).args(args).stdin(Stdio::null());
        gleaner.output().expect("gleaner starts")
    }

    /// Runs `gleaner` as a user of the cloud; returns its standard output.
    pub fn succeeds(&self, args: &[&str]) -> String {
        let output = self.gleaner(args);
        assert!(output.status.success(), "{args:?}: {}", text(&output));
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    /// Returns a vehicle as the cloud lists it.
    pub fn vehicle(&self, name: &str) -> VehicleSummary {
        let all = self.succeeds(&["vehicles", "--json"]);
        let mut all: Vec<VehicleSummary> = serde_json::from_str(&all).expect("a list");
        all.retain(|vehicle| vehicle.name == name);
        all.pop().expect("it was enrolled")
    }

    /// Returns the records of a deployment that the cloud has, or the events without one.
    pub fn records(&self, vehicle: &str, id: Option<&str>) -> Vec<StreamLine> {
        let on = ["--on", vehicle, "--json", "-n", "10000"];
        let lines = match id {
            Some(id) => self.succeeds(&[&["logs", id], &on[..]].concat()),
            None => self.succeeds(&[&["events"], &on[..]].concat()),
        };
        lines.lines().map(|line| serde_json::from_str(line).expect("a line is a record")).collect()
    }
}

impl Drop for TestCloud {
    fn drop(&mut self) {
        self.kill();
    }
}
