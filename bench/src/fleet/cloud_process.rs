//! The cloud as a process of its own, on a temporary folder: started, stopped, killed and measured.

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use rustix::process::{Pid, Signal, kill_process};

/// A running cloud, killed when it is dropped.
pub struct CloudProcess {
    child: Child,
    pub people: SocketAddr,
    pub vehicles: SocketAddr,
    /// The one-time code of the administrator; a folder that was used before has none.
    pub code: Option<String>,
    folder: PathBuf,
}

impl CloudProcess {
    /// Starts a cloud on `folder`, and waits until it listens.
    pub fn start(folder: &Path) -> Result<Self, String> {
        let any = SocketAddr::from(([127, 0, 0, 1], 0));
        Self::start_at(folder, any, any)
    }

    fn start_at(folder: &Path, people: SocketAddr, vehicles: SocketAddr) -> Result<Self, String> {
        let own = std::env::current_exe().map_err(|error| error.to_string())?;
        let program = own.with_file_name("gleaner-cloud");
        let mut child = Command::new(&program)
            .args(["serve", "--http", &people.to_string(), "--vehicles", &vehicles.to_string()])
            .arg("--data")
            .arg(folder)
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| format!("cannot start `{}`: {error}", program.display()))?;
        let is_first = !folder.join("cloud.db").exists();
        let mut lines = BufReader::new(child.stdout.take().ok_or("no output")?).lines();
        let mut value = |name: &str| {
            let line = lines.next().and_then(Result::ok).unwrap_or_default();
            let value = line.strip_prefix(name).map(|value| value.trim().to_owned());
            value.ok_or_else(|| format!("the cloud printed `{line}` instead of `{name}`"))
        };
        let address = |text: &str| {
            let parsed = text.trim_start_matches("http://").parse::<SocketAddr>();
            parsed.map_err(|error| format!("`{text}`: {error}"))
        };
        let people = address(&value("people:")?)?;
        let vehicles = address(&value("vehicles:")?)?;
        let code = is_first.then(|| value("first:")).transpose()?;
        let code = code.and_then(|line| line.rsplit(' ').next().map(str::to_owned));
        Ok(Self { child, people, vehicles, code, folder: folder.to_owned() })
    }

    /// Stops the cloud as a service does, and starts it again at the same addresses.
    pub fn restart(mut self) -> Result<Self, String> {
        kill_process(Pid::from_child(&self.child), Signal::TERM)
            .map_err(|error| format!("the cloud cannot be stopped: {error}"))?;
        self.child.wait().map_err(|error| error.to_string())?;
        Self::start_at(&self.folder, self.people, self.vehicles)
    }

    /// Kills the cloud.
    pub fn kill(&mut self) {
        // It may have ended already, which the next start shows.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Starts it again after [`kill`](Self::kill), at the same addresses.
    pub fn start_again(&mut self) -> Result<(), String> {
        *self = Self::start_at(&self.folder, self.people, self.vehicles)?;
        Ok(())
    }

    /// Returns its resident memory, in kB of 1,000 bytes.
    pub fn memory_kb(&self) -> f64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id()));
        let status = status.unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
        kib.unwrap_or(f64::NAN) * 1.024
    }

    /// Returns the time that its threads have run, in s.
    pub fn cpu_s(&self) -> f64 {
        let stat = fs::read_to_string(format!("/proc/{}/stat", self.child.id()));
        let stat = stat.unwrap_or_default();
        let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace();
        let ticks: f64 = fields.skip(11).take(2).filter_map(|it| it.parse::<f64>().ok()).sum();
        ticks / rustix::param::clock_ticks_per_second() as f64
    }
}

impl Drop for CloudProcess {
    fn drop(&mut self) {
        self.kill();
    }
}
