//! A program of the scaled cloud: started, killed, started again, and ended with its value.

use std::fs;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use rustix::process::{Pid, Signal, kill_process_group};

use crate::checkout::Checkout;

/// Time for a program to listen.
const START: Duration = Duration::from_secs(60);
const LOOK: Duration = Duration::from_millis(50);

/// A running program with its processes, which end with this value.
pub(super) struct Service {
    pub(super) name: &'static str,
    command: Command,
    child: Child,
    address: SocketAddr,
    log: PathBuf,
}

impl Service {
    /// Starts a program, and waits until it listens. Its output is in the file `log`.
    pub(super) fn start(
        name: &'static str,
        mut command: Command,
        address: SocketAddr,
        path: &Path,
    ) -> Result<Self, Failure> {
        let failed =
            |error| Failure::caused_by(Exit::Internal, format!("cannot start {name}"), &error);
        // Private: the log of a replica has the code of the administrator.
        let mut private = fs::OpenOptions::new();
        private.write(true).create_new(true).mode(0o600);
        let log = private.open(path).map_err(failed)?;
        let errors = log.try_clone().map_err(failed)?;
        command.stdin(Stdio::null()).stdout(log).stderr(errors);
        // A group of its own, so that the end reaches its children, and ctrl-C only this program.
        command.process_group(0);
        let child = command.spawn().map_err(failed)?;
        let mut service = Self { name, command, child, address, log: path.to_owned() };
        service.listens()?;
        Ok(service)
    }

    fn listens(&mut self) -> Result<(), Failure> {
        let begun = Instant::now();
        while TcpStream::connect(self.address).is_err() {
            // PostgreSQL refuses to start until the processes of a killed one have ended.
            if !matches!(self.child.try_wait(), Ok(None)) {
                sleep(10 * LOOK);
                if let Ok(child) = self.command.spawn() {
                    self.child = child;
                }
            }
            if begun.elapsed() > START {
                let message = format!("{} does not listen at {}", self.name, self.address);
                let log = fs::read_to_string(&self.log).unwrap_or_default();
                let mut failure = Failure::new(Exit::Internal, message);
                failure.causes.extend(log.lines().next_back().map(str::to_owned));
                return Err(failure.with_help("run `cargo xtask fleet` again"));
            }
            sleep(LOOK);
        }
        Ok(())
    }

    pub(super) fn kill_and_start(&mut self) -> Result<(), Failure> {
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.child = self.command.spawn().map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot start {}", self.name), &error)
        })?;
        self.listens()
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = kill_process_group(Pid::from_child(&self.child), Signal::KILL);
        let _ = self.child.wait();
    }
}

/// Returns addresses of this machine that no program has.
pub(super) fn free_addresses<const N: usize>() -> Result<[SocketAddr; N], Failure> {
    let failed = |error| Failure::caused_by(Exit::Internal, "no port is free", &error);
    let mut addresses = [SocketAddr::from(([127, 0, 0, 1], 0)); N];
    // All at once, so that they differ.
    let listeners = addresses.iter().map(TcpListener::bind).collect::<Result<Vec<_>, _>>();
    for (address, listener) in addresses.iter_mut().zip(listeners.map_err(failed)?) {
        *address = listener.local_addr().map_err(failed)?;
    }
    Ok(addresses)
}

pub(super) fn find(checkout: &Checkout, name: &str) -> Option<PathBuf> {
    let own = checkout.target().join("fleet/venv/bin");
    let path = std::env::var_os("PATH").unwrap_or_default();
    let folders = std::env::split_paths(&path);
    let all = [own].into_iter().chain(folders).chain(["/usr/sbin".into(), postgres()]);
    all.map(|folder| folder.join(name)).find(|path| path.is_file())
}

/// Returns the folder of the newest PostgreSQL of Debian's packages.
fn postgres() -> PathBuf {
    let versions = fs::read_dir("/usr/lib/postgresql");
    let folders = versions.into_iter().flatten().flatten().map(|entry| entry.path().join("bin"));
    folders.max().unwrap_or_default()
}

/// Returns the packages of Debian whose programs are missing.
pub(super) fn missing(checkout: &Checkout) -> Vec<&'static str> {
    let all = [("initdb", "postgresql"), ("nats-server", "nats-server"), ("haproxy", "haproxy")];
    let missing = all.into_iter().filter(|(name, _)| find(checkout, name).is_none());
    missing.map(|(_, package)| package).collect()
}
