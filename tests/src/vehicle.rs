//! A vehicle for tests: keys, a trust root, and an orchestrator in folders of its own.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_protocol::supervision::LambdaPhase;
use gleaner_protocol::vehicle_api::{DeploymentStatus, StreamLine, VehicleStatus};

use crate::live::{PATIENCE, descendants, signal};
use crate::{TempFolder, program};

/// The vehicle. Dropping it ends all of its processes.
pub struct TestVehicle {
    folder: TempFolder,
    orchestrator: Option<Child>,
}

impl TestVehicle {
    /// Makes keys and a trust root; nothing runs yet.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        let vehicle = Self { folder: TempFolder::new(), orchestrator: None };
        for key in ["root", "publisher", "deployer", "stranger"] {
            vehicle.succeeds(&["keys", "new", &vehicle.key(key)]);
        }
        let [root, publisher, deployer] =
            ["root", "publisher", "deployer"].map(|key| vehicle.key(key));
        let trust = vehicle.path("trust.json");
        let trust = trust.to_str().expect("a plain path");
        let keys = ["--root", &root, "--publisher", &publisher, "--deployer", &deployer];
        vehicle.succeeds(&[&["trust", "new", trust], &keys[..]].concat());
        vehicle
    }

    /// As [`new`](Self::new), with an orchestrator.
    pub fn started() -> Self {
        let mut vehicle = Self::new();
        vehicle.start();
        vehicle
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Returns the file of a key: `root`, `publisher`, `deployer`, or `stranger`.
    pub fn key(&self, name: &str) -> String {
        let path = self.path(&format!("{name}.pem"));
        path.to_str().expect("a plain path").to_owned()
    }

    /// Starts the orchestrator, and waits until it answers. Installs the trust root if there is
    /// none.
    pub fn start(&mut self) {
        let log = self.path("orchestrator.log");
        let log = std::fs::File::options().create(true).append(true).open(log);
        let mut command = Command::new(program("gleaner-orchestrator"));
        command.arg("--state").arg(self.path("state")).arg("--run").arg(self.path("run"));
        let config = self.path("vehicle.toml");
        if config.is_file() {
            command.arg("--vehicle").arg(config);
        }
        // Programs in it are used instead of those that were built.
        let home = self.path("home");
        if home.is_dir() {
            command.env("GLEANER_HOME", home);
        }
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log.expect("a log"));
        self.orchestrator = Some(command.spawn().expect("the orchestrator starts"));
        let status = self.until("the orchestrator to answer", |vehicle| vehicle.try_status());
        if status.trust.is_none() {
            let trust = self.path("trust.json");
            self.succeeds(&["trust", "install", trust.to_str().expect("a plain path")]);
        }
    }

    /// Returns the process id of the orchestrator.
    pub fn orchestrator(&self) -> u32 {
        self.orchestrator.as_ref().expect("it runs").id()
    }

    /// Returns the process id of the supervisor, after waiting for its start.
    pub fn supervisor(&self) -> u32 {
        self.until("a supervisor", |vehicle| {
            let text = std::fs::read_to_string(vehicle.path("state/supervisor.lock"));
            text.ok()?.trim().parse().ok()
        })
    }

    /// Returns the process ids below the supervisor whose command line contains `name`.
    pub fn processes(&self, name: &str) -> Vec<u32> {
        descendants(self.supervisor(), name)
    }

    /// Sends SIGKILL to the orchestrator, and waits for its end.
    pub fn kill_orchestrator(&mut self) {
        if let Some(mut orchestrator) = self.orchestrator.take() {
            let _ = orchestrator.kill();
            let _ = orchestrator.wait();
        }
    }

    /// Replaces the program of the orchestrator by SIGHUP, and waits until the next one answers.
    pub fn reload(&self) {
        let requested = Instant::now();
        signal(self.orchestrator(), "HUP");
        self.until("the next program", |vehicle| {
            let up = Duration::from_secs_f64(vehicle.try_status()?.orchestrator.up_s);
            (up < requested.elapsed()).then_some(())
        });
    }

    /// Ends the orchestrator by SIGTERM, and with it all processes.
    pub fn stop(&mut self) {
        let Some(mut orchestrator) = self.orchestrator.take() else { return };
        signal(orchestrator.id(), "TERM");
        let ended = self.until("its end", |_| orchestrator.try_wait().ok().flatten());
        assert!(ended.success(), "{ended}: {}", self.log());
    }

    /// Signs a build with the key `by`.
    pub fn publish(&self, lambda: &Path, by: &str) -> Output {
        let lambda = lambda.to_str().expect("a plain path");
        self.gleaner(&["publish", lambda, "--key", &self.key(by)])
    }

    /// Publishes a build, and deploys it with further arguments.
    pub fn deploy(&self, lambda: &Path, args: &[&str]) -> Output {
        let published = self.publish(lambda, "publisher");
        assert!(published.status.success(), "{}", text(&published));
        let lambda = lambda.to_str().expect("a plain path");
        let key = self.key("deployer");
        self.gleaner(&[&["deploy", "--local", lambda, "--key", &key], args].concat())
    }

    /// Publishes and deploys a build.
    pub fn deploys(&self, lambda: &Path) {
        let deployed = self.deploy(lambda, &[]);
        assert!(deployed.status.success(), "{}", text(&deployed));
    }

    /// Runs `gleaner` with these arguments.
    pub fn gleaner(&self, args: &[&str]) -> Output {
        let mut gleaner = Command::new(program("gleaner"));
        gleaner.env("GLEANER_RUN", self.path("run")).args(args).stdin(Stdio::null());
        gleaner.output().expect("gleaner starts")
    }

    /// Runs `gleaner` with these arguments; returns its standard output.
    pub fn succeeds(&self, args: &[&str]) -> String {
        let output = self.gleaner(args);
        assert!(output.status.success(), "{args:?}: {}\n{}", text(&output), self.log());
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    /// Returns the status of the vehicle.
    pub fn status(&self) -> VehicleStatus {
        self.try_status().unwrap_or_else(|| panic!("no status: {}", self.log()))
    }

    /// Returns the status of the vehicle, if the orchestrator answers.
    pub fn try_status(&self) -> Option<VehicleStatus> {
        let output = self.gleaner(&["status", "--json"]);
        serde_json::from_slice(&output.stdout).ok()
    }

    /// Returns the status of a deployment.
    pub fn deployment(&self, id: &str) -> DeploymentStatus {
        let deployments = self.status().deployments;
        deployments.into_iter().find(|it| it.id == id).expect("it is deployed")
    }

    /// Waits until these deployments run; returns the time that it took.
    pub fn until_running(&self, ids: &[&str]) -> Duration {
        let started = Instant::now();
        self.until(&format!("{ids:?} to run"), |vehicle| {
            Self::all_run(&vehicle.try_status()?, ids).then_some(())
        });
        started.elapsed()
    }

    pub fn all_run(status: &VehicleStatus, ids: &[&str]) -> bool {
        let runs = |id: &&str| {
            let of_id = status.deployments.iter().find(|it| it.id == **id);
            of_id.and_then(|it| it.status.as_ref()).map(|it| it.phase) == Some(LambdaPhase::Running)
        };
        ids.iter().all(runs)
    }

    /// Returns the records of a deployment, or the events without one.
    pub fn records(&self, id: Option<&str>) -> Vec<StreamLine> {
        let all = ["--json", "-n", "10000"];
        let lines = match id {
            Some(id) => self.succeeds(&[&["logs", id], &all[..]].concat()),
            None => self.succeeds(&[&["events"], &all[..]].concat()),
        };
        lines.lines().map(|line| serde_json::from_str(line).expect("a line is a record")).collect()
    }

    /// Waits until `wanted` returns a value.
    pub fn until<T>(&self, what: &str, mut wanted: impl FnMut(&Self) -> Option<T>) -> T {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(found) = wanted(self) {
                return found;
            }
            assert!(Instant::now() < deadline, "waited for {what}: {}", self.log());
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Returns what the orchestrator has written, and the status.
    pub fn log(&self) -> String {
        let log = std::fs::read_to_string(self.path("orchestrator.log")).unwrap_or_default();
        let events = self.gleaner(&["events"]);
        format!("log:\n{log}\nevents:\n{}", String::from_utf8_lossy(&events.stdout))
    }
}

impl Drop for TestVehicle {
    fn drop(&mut self) {
        if self.orchestrator.is_none() && self.path("state/supervisor.lock").is_file() {
            self.start();
        }
        if let Some(mut orchestrator) = self.orchestrator.take() {
            signal(orchestrator.id(), "TERM");
            let _ = orchestrator.wait();
        }
    }
}

pub fn text(output: &Output) -> String {
    let [out, error] = [&output.stdout, &output.stderr].map(|it| String::from_utf8_lossy(it));
    format!("{}\n{out}{error}", output.status)
}
