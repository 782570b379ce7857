//! Starts and ends one process of a run.

use std::ffi::OsString;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure};
use gleaner_protocol::link::LinkError;
use gleaner_protocol::{Handover, SHUTDOWN_TIMEOUT};
use rustix::net::sockopt::set_socket_send_buffer_size;
use rustix::process::{Pid, Signal, kill_process};

use crate::output::{self, ChildId, ChildOutput};

/// Time for a process to end, such as to finish a wake or to complete clips. A shim kills its
/// runtime before.
const END_TIMEOUT: Duration = SHUTDOWN_TIMEOUT.saturating_add(Duration::from_secs(10));

/// Size of the socket for connections, in bytes. It has room for some messages only: each unread
/// one keeps the memory of an ingress that has ended.
const HANDOVER_BYTES: usize = 4096;

/// A Gleaner program that reports as JSON lines.
pub(crate) struct ChildProcess {
    name: &'static str,
    child: Child,
    /// Our end of its standard input: open, as its end would mean that this program has ended.
    handover: UnixStream,
    /// Time of the request to end or of the first check whether it is late, then of the last kill.
    requested: Option<Instant>,
}

impl ChildProcess {
    /// Starts the program `name` with these connections. `prefix` is the text before each line of
    /// its standard error. `shim` are the arguments of gleaner-shim, which starts the program if
    /// they are given, and the interpreter that the program has to use, if it runs Python.
    pub(crate) fn start(
        parts: &InstalledPrograms,
        (name, id, prefix): (&'static str, ChildId, &str),
        line: Vec<OsString>,
        shim: Option<(Vec<OsString>, Option<&Path>)>,
        connections: Handover,
        sender: &SyncSender<ChildOutput>,
    ) -> Result<Self, Failure> {
        let (shim, python) = shim.unzip();
        let (program, line) = command_line(parts, name, line, shim)?;
        let failed = |error: &dyn std::error::Error| {
            let program = program.display();
            Failure::caused_by(Exit::Internal, format!("cannot start `{program}`"), error)
        };
        let (handover, stdin) = UnixStream::pair().map_err(|error| failed(&error))?;
        set_socket_send_buffer_size(&handover, HANDOVER_BYTES)
            .map_err(|error| failed(&io::Error::from(error)))?;
        connections.send(&handover).map_err(|error| failed(&error))?;
        // No other interpreter is tried then.
        let python = python.flatten().map(|python| ("GLEANER_PYTHON", python));
        let mut child = Command::new(&program)
            .args(line)
            .envs(python)
            // Only `gleaner` receives Ctrl-C, and ends its processes in order.
            .process_group(0)
            .stdin(OwnedFd::from(stdin))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| failed(&error))?;
        output::forward(&mut child, (id, prefix), sender);
        Ok(Self { name, child, handover, requested: None })
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    pub(crate) fn status(&mut self) -> Result<Option<ExitStatus>, Failure> {
        let failed = |error| {
            Failure::caused_by(Exit::Internal, format!("cannot wait for {}", self.name), &error)
        };
        self.child.try_wait().map_err(failed)
    }

    /// Passes it connections to processes that were started again. If it does not read its
    /// messages, it is killed; returns the warning to print.
    pub(crate) fn pass(&self, connections: &Handover) -> Option<String> {
        match connections.try_send(&self.handover) {
            // Its exit status explains why it has ended.
            Ok(()) | Err(LinkError::Gone { .. }) => None,
            Err(error) => {
                self.kill();
                Some(format!("{}: {error}; killing it", self.name))
            }
        }
    }

    pub(crate) fn kill(&self) {
        self.signal(Signal::KILL);
    }

    pub(crate) fn terminate(&mut self) {
        self.signal(Signal::TERM);
        self.requested = Some(Instant::now());
    }

    /// Kills the process if it has not ended within [`END_TIMEOUT`] of the request, or of the first
    /// call. Returns the warning to print, if it does so.
    pub(crate) fn kill_if_late(&mut self) -> Option<String> {
        let requested = self.requested.get_or_insert_with(Instant::now);
        if requested.elapsed() <= END_TIMEOUT {
            return None;
        }
        *requested = Instant::now();
        self.kill();
        Some(format!("{} did not end on request; killing it", self.name))
    }

    fn signal(&self, signal: Signal) {
        // Fails if the process has just ended.
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, signal);
        }
    }
}

impl Drop for ChildProcess {
    fn drop(&mut self) {
        // It is still running only if an error skipped the wait.
        if let Ok(None) = self.child.try_wait() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// Returns the program to start and its arguments: `name`, or the shim that starts it.
fn command_line(
    parts: &InstalledPrograms,
    name: &str,
    line: Vec<OsString>,
    shim: Option<Vec<OsString>>,
) -> Result<(PathBuf, Vec<OsString>), Failure> {
    let program = parts.program(name)?;
    let Some(shim) = shim else { return Ok((program, line)) };
    let below = ["--".into(), program.into()];
    Ok((parts.program("gleaner-shim")?, shim.into_iter().chain(below).chain(line).collect()))
}
