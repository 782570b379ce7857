//! The vehicle of the demo: its folders, keys and orchestrator, and commands to it.

use std::fs::{self, File};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::{DeploymentStatus, VehicleStatus};
use rustix::process::{Pid, Signal, kill_process};

use crate::checkout::Checkout;
use crate::steps;

/// Folder of everything that the demo leaves, relative to the checkout.
pub(super) const OUT: &str = "out/demo/vehicle";

/// The configuration of the vehicle. Two cores are just enough for all examples in both languages.
const SETTINGS: &str = "[vehicle]\nname = \"demo-car\"\n[deployments]\ncpu = 1\nmodel_time = 1\n";

/// Longest wait for anything: far longer than needed.
const PATIENCE: Duration = Duration::from_secs(60);

/// Time between two looks at the status.
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// The vehicle. Dropping it ends all of its processes.
pub(super) struct DemoVehicle<'c> {
    checkout: &'c Checkout,
    /// Folder of the sockets: in a temporary place, as their paths must be short.
    run: PathBuf,
    orchestrator: Option<Child>,
}

impl<'c> DemoVehicle<'c> {
    /// Makes keys and a trust root, starts the orchestrator, and installs the trust root.
    pub(super) fn start(checkout: &'c Checkout) -> Result<Self, Failure> {
        let out = checkout.path(OUT);
        let run = std::env::temp_dir().join(format!("gleaner-demo-{}", std::process::id()));
        let prepared = remove(&out)
            .and_then(|()| fs::create_dir_all(&out))
            .and_then(|()| fs::write(out.join("vehicle.toml"), SETTINGS))
            .and_then(|()| fs::DirBuilder::new().mode(0o700).create(&run))
            .and_then(|()| File::create(out.join("orchestrator.log")));
        let log = prepared.map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot prepare `{OUT}`"), &error)
        })?;
        let mut vehicle = Self { checkout, run, orchestrator: None };
        for key in ["root", "publisher", "deployer"] {
            vehicle.gleaner(&["keys", "new", &file(&format!("{key}.pem"))])?;
        }
        let trust = file("trust.json");
        let [root, publisher, deployer] =
            ["root", "publisher", "deployer"].map(|key| file(&format!("{key}.pem")));
        let keys = ["--root", &root, "--publisher", &publisher, "--deployer", &deployer];
        vehicle.gleaner(&[&["trust", "new", &trust], &keys[..]].concat())?;
        let mut orchestrator = checkout.command(checkout.program("gleaner-orchestrator"));
        orchestrator.arg("--state").arg(out.join("state")).arg("--run").arg(&vehicle.run);
        orchestrator.arg("--vehicle").arg(out.join("vehicle.toml"));
        orchestrator.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
        let started = orchestrator.spawn().map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot start gleaner-orchestrator", &error)
        })?;
        vehicle.orchestrator = Some(started);
        vehicle.until("gleaner-orchestrator to answer", |_| Some(()))?;
        vehicle.gleaner(&["trust", "install", &trust])?;
        Ok(vehicle)
    }

    /// Returns a command `gleaner` to the vehicle.
    fn command(&self, arguments: &[&str]) -> Command {
        let mut gleaner = self.checkout.command(self.checkout.program("gleaner"));
        gleaner.env("GLEANER_RUN", &self.run).args(arguments);
        gleaner
    }

    /// Runs `gleaner` with these arguments; returns its standard output.
    pub(super) fn gleaner(&self, arguments: &[&str]) -> Result<String, Failure> {
        steps::output(&mut self.command(arguments), &see_log())
    }

    /// Runs `gleaner` with these arguments, with its output shown.
    pub(super) fn show(&self, arguments: &[&str]) -> Result<(), Failure> {
        steps::run(&mut self.command(arguments), &see_log())
    }

    /// Returns the status, if the orchestrator answers.
    fn status(&self) -> Option<VehicleStatus> {
        let output = self.command(&["status", "--json"]).stdin(Stdio::null()).output().ok()?;
        serde_json::from_slice(&output.stdout).ok()
    }

    /// Waits until `wanted` returns a value for a status.
    pub(super) fn until<T>(
        &self,
        what: &str,
        mut wanted: impl FnMut(&VehicleStatus) -> Option<T>,
    ) -> Result<T, Failure> {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Some(found) = self.status().and_then(|status| wanted(&status)) {
                return Ok(found);
            }
            thread::sleep(POLL_INTERVAL);
        }
        let message = format!("waited {} s for {what}", PATIENCE.as_secs());
        Err(Failure::new(Exit::Internal, message).with_help(see_log()))
    }

    /// Waits until `wanted` returns a value for the status of a deployment.
    pub(super) fn until_lambda<T>(
        &self,
        id: &str,
        what: &str,
        mut wanted: impl FnMut(&DeploymentStatus) -> Option<T>,
    ) -> Result<T, Failure> {
        self.until(&format!("`{id}` {what}"), |status| {
            wanted(status.deployments.iter().find(|deployment| deployment.id == id)?)
        })
    }

    /// Ends the orchestrator in order, and with it all processes.
    pub(super) fn stop(mut self) -> Result<(), Failure> {
        let Some(orchestrator) = self.orchestrator.as_mut() else { return Ok(()) };
        terminate(orchestrator);
        let deadline = Instant::now() + PATIENCE;
        let ended = loop {
            match orchestrator.try_wait() {
                Ok(Some(status)) => break status.to_string(),
                Ok(None) if Instant::now() < deadline => thread::sleep(POLL_INTERVAL),
                Ok(None) => return Err(not_in_order("it does not end")),
                Err(error) => return Err(not_in_order(&error.to_string())),
            }
        };
        match self.orchestrator.take().map(|mut it| it.wait()) {
            Some(Ok(status)) if status.success() => Ok(()),
            _ => Err(not_in_order(&ended)),
        }
    }
}

impl Drop for DemoVehicle<'_> {
    fn drop(&mut self) {
        if let Some(orchestrator) = &mut self.orchestrator {
            terminate(orchestrator);
            let _ = orchestrator.wait();
        }
        let _ = fs::remove_dir_all(&self.run);
    }
}

/// Path of a file of the demo, relative to the checkout.
pub(super) fn file(name: &str) -> String {
    format!("{OUT}/{name}")
}

/// Sends a signal to a process.
pub(super) fn signal(pid: u32, signal: Signal) -> Result<(), Failure> {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    let pid = pid.ok_or_else(|| Failure::new(Exit::Internal, "the process has no number"))?;
    kill_process(pid, signal)
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot signal a process", &error))
}

fn terminate(child: &Child) {
    // Of one that has ended, its number is kept until it is waited for.
    let _ = signal(child.id(), Signal::TERM);
}

fn not_in_order(why: &str) -> Failure {
    let mut failure = Failure::new(Exit::Internal, "the orchestrator did not end in order");
    failure.causes = vec![why.to_owned()];
    failure.with_help(see_log())
}

fn see_log() -> String {
    format!("`{OUT}/orchestrator.log` is the log of the orchestrator")
}

fn remove(folder: &Path) -> std::io::Result<()> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}
