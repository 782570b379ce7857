//! The vehicle of the demo: its folders, keys and orchestrator, and commands to it and its cloud,
//! if it has one.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::{DeploymentStatus, VehicleStatus};
use rustix::process::{Pid, Signal, kill_process};
use signal_hook::consts::SIGTERM;

use super::demo_cloud::account;
use crate::checkout::Checkout;
use crate::onnxruntime;
use crate::steps;

/// Folder of everything that the demo leaves, relative to the checkout.
pub(super) const OUT: &str = "out/demo/vehicle";

pub(super) const NAME: &str = "demo-car";

/// The configuration of the vehicle. Two cores are just enough for all examples in both languages.
const SETTINGS: &str = "[vehicle]\nname = \"demo-car\"\nlabels = { fleet = \"demo\" }\n\
                        [deployments]\ncpu = 1\nmodel_time = 1\n";

/// Longest wait for anything: far longer than needed.
const PATIENCE: Duration = Duration::from_secs(60);

const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// The vehicle. Dropping it ends all of its processes.
pub(super) struct DemoVehicle<'c> {
    checkout: &'c Checkout,
    /// Folder of the sockets.
    run: PathBuf,
    orchestrator: Option<Child>,
    pub(super) has_cloud: bool,
    /// Set by SIGTERM: the demo is to end.
    ends: Arc<AtomicBool>,
}

impl<'c> DemoVehicle<'c> {
    /// Makes keys and a trust root, starts the orchestrator with its sockets in `run`, installs the
    /// trust root, and enrols the vehicle at the cloud, if it has one.
    pub(super) fn start(
        checkout: &'c Checkout,
        run: &Path,
        has_cloud: bool,
    ) -> Result<Self, Failure> {
        let (out, ends) = (checkout.path(OUT), Arc::new(AtomicBool::new(false)));
        steps::remove_folder(&out)?;
        steps::make_folder(&out)?;
        let prepared = fs::write(out.join("vehicle.toml"), SETTINGS)
            .and_then(|()| signal_hook::flag::register(SIGTERM, Arc::clone(&ends)))
            .and_then(|_| File::create(out.join("orchestrator.log")));
        let log = prepared.map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot prepare `{OUT}`"), &error)
        })?;
        let mut vehicle =
            Self { checkout, run: run.to_owned(), orchestrator: None, has_cloud, ends };
        for key in ["root", "publisher", "deployer"] {
            vehicle.gleaner(&["keys", "new", &file(&format!("{key}.pem"))])?;
        }
        let trust = file("trust.json");
        let [root, publisher, deployer] =
            ["root", "publisher", "deployer"].map(|key| file(&format!("{key}.pem")));
        let keys = ["--root", &root, "--publisher", &publisher, "--deployer", &deployer];
        vehicle.gleaner(&[&["trust", "new", &trust], &keys[..]].concat())?;
        let mut orchestrator = onnxruntime::with_models(checkout, "gleaner-orchestrator");
        orchestrator.arg("--state").arg(out.join("state")).arg("--run").arg(&vehicle.run);
        orchestrator.arg("--vehicle").arg(out.join("vehicle.toml"));
        orchestrator.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
        let started = orchestrator.spawn().map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot start gleaner-orchestrator", &error)
        })?;
        vehicle.orchestrator = Some(started);
        vehicle.until("gleaner-orchestrator to answer", |_| Some(()))?;
        vehicle.gleaner(&["trust", "install", &trust])?;
        if has_cloud {
            let enrolment = file("enrolment.json");
            vehicle.gleaner(&["vehicles", "enrol", NAME, "--to", &enrolment])?;
            vehicle.gleaner(&["enrol", &enrolment])?;
        }
        Ok(vehicle)
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut gleaner = self.checkout.command(self.checkout.program("gleaner"));
        gleaner.env("GLEANER_RUN", &self.run).args(arguments);
        account(self.checkout, &mut gleaner);
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

    fn status(&self) -> Option<VehicleStatus> {
        let output = self.command(&["status", "--json"]).stdin(Stdio::null()).output().ok()?;
        serde_json::from_slice(&output.stdout).ok()
    }

    pub(super) fn until<T>(
        &self,
        what: &str,
        mut wanted: impl FnMut(&VehicleStatus) -> Option<T>,
    ) -> Result<T, Failure> {
        self.look_until(what, || Ok(self.status().and_then(|status| wanted(&status))))
    }

    pub(super) fn look_until<T>(
        &self,
        what: &str,
        mut look: impl FnMut() -> Result<Option<T>, Failure>,
    ) -> Result<T, Failure> {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if self.ends.load(Ordering::Relaxed) {
                return Err(Failure::new(Exit::Internal, "the demo was ended"));
            }
            if let Some(found) = look()? {
                return Ok(found);
            }
            thread::sleep(POLL_INTERVAL);
        }
        let message = format!("waited {} s for {what}", PATIENCE.as_secs());
        Err(Failure::new(Exit::Internal, message).with_help(see_log()))
    }

    pub(super) fn until_end(&self) {
        while !self.ends.load(Ordering::Relaxed) {
            thread::sleep(POLL_INTERVAL);
        }
    }

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
        self.orchestrator.take().map_or(Ok(()), |program| end(program, "gleaner-orchestrator"))
    }
}

impl Drop for DemoVehicle<'_> {
    fn drop(&mut self) {
        if let Some(program) = self.orchestrator.take() {
            let _ = end(program, "gleaner-orchestrator");
        }
    }
}

/// Path of a file of the demo, relative to the checkout.
pub(super) fn file(name: &str) -> String {
    format!("{OUT}/{name}")
}

pub(super) fn signal(pid: u32, signal: Signal) -> Result<(), Failure> {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    let pid = pid.ok_or_else(|| Failure::new(Exit::Internal, "the process has no number"))?;
    kill_process(pid, signal)
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot signal a process", &error))
}

pub(super) fn end(mut program: Child, name: &str) -> Result<(), Failure> {
    // Of one that has ended, its number is kept until it is waited for.
    let _ = signal(program.id(), Signal::TERM);
    let deadline = Instant::now() + PATIENCE;
    let ended = loop {
        match program.try_wait() {
            Ok(Some(status)) if status.success() => return Ok(()),
            Ok(Some(status)) => break status.to_string(),
            Ok(None) if Instant::now() < deadline => thread::sleep(POLL_INTERVAL),
            Ok(None) => break "it does not end".to_owned(),
            Err(error) => break error.to_string(),
        }
    };
    let mut failure = Failure::new(Exit::Internal, format!("{name} did not end in order"));
    failure.causes = vec![ended];
    Err(failure.with_help(see_log()))
}

fn see_log() -> String {
    format!("the logs are `{OUT}/orchestrator.log` and `out/demo/cloud.log`")
}
