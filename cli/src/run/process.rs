//! Starts, reads and ends one process of a run.

use std::ffi::OsString;
use std::io::{BufReader, Read};
use std::os::fd::OwnedFd;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::SyncSender;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, visible};
use gleaner_parts::Parts;
use gleaner_protocol::SHUTDOWN_TIMEOUT;
use rustix::process::{Pid, Signal, kill_process};
use serde::de::DeserializeOwned;

use super::POLL_INTERVAL;
use super::report_stream::{ChildOutput, ReportStream};
use super::screen::Screen;
use crate::runtime::next_report;

/// Time for a process to end, such as to finish a wake or to complete clips. A shim kills its
/// runtime before.
const END_TIMEOUT: Duration = SHUTDOWN_TIMEOUT.saturating_add(Duration::from_secs(10));

/// A Gleaner program that reports as JSON lines.
pub(super) struct ChildProcess {
    name: &'static str,
    child: Child,
}

impl ChildProcess {
    /// Starts the program `name`, whose reports are `T` and become outputs by `wrap`. `shim` are
    /// the arguments of gleaner-shim, which starts the program if they are given.
    pub(super) fn start<T: DeserializeOwned + 'static>(
        parts: &Parts,
        name: &'static str,
        line: Vec<OsString>,
        stdin: Option<OwnedFd>,
        shim: Option<Vec<OsString>>,
        wrap: fn(T) -> ChildOutput,
        sender: &SyncSender<ChildOutput>,
    ) -> Result<Self, Failure> {
        let (program, line) = command_line(parts, name, line, shim)?;
        let mut child = Command::new(&program)
            .args(line)
            // Only `gleaner` receives Ctrl-C, and ends its processes in order.
            .process_group(0)
            .stdin(stdin.map_or_else(Stdio::null, Stdio::from))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| {
                Failure::caused_by(
                    Exit::Internal,
                    format!("cannot start `{}`", program.display()),
                    &error,
                )
            })?;
        if let Some(reports) = child.stdout.take() {
            let sender = sender.clone();
            thread::spawn(move || follow(reports, wrap, &sender));
        }
        if let Some(stderr) = child.stderr.take() {
            let sender = sender.clone();
            let pass_on =
                move |piece: &[u8]| drop(sender.send(ChildOutput::Stderr(piece.to_vec())));
            thread::spawn(move || {
                crate::runtime::pass_on(stderr, &AtomicBool::new(false), pass_on)
            });
        }
        Ok(Self { name, child })
    }

    /// Returns the exit status of the process; `None` while it runs.
    pub(super) fn status(&mut self) -> Result<Option<ExitStatus>, Failure> {
        let failed = |error| {
            Failure::caused_by(Exit::Internal, format!("cannot wait for {}", self.name), &error)
        };
        self.child.try_wait().map_err(failed)
    }

    /// Sends SIGTERM, and waits for the end of the process.
    pub(super) fn end(
        &mut self,
        stream: &mut ReportStream,
        screen: &mut Screen,
    ) -> Result<ExitStatus, Failure> {
        self.signal(Signal::TERM);
        self.wait(stream, screen)
    }

    /// Waits for the end of the process, and kills it after [`END_TIMEOUT`].
    pub(super) fn wait(
        &mut self,
        stream: &mut ReportStream,
        screen: &mut Screen,
    ) -> Result<ExitStatus, Failure> {
        let mut requested = Instant::now();
        loop {
            stream.poll(screen, POLL_INTERVAL);
            if let Some(status) = self.status()? {
                return Ok(status);
            }
            if requested.elapsed() > END_TIMEOUT {
                screen.warn(&format!("{} did not end on request; killing it", self.name));
                self.signal(Signal::KILL);
                requested = Instant::now();
            }
        }
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
    parts: &Parts,
    name: &str,
    line: Vec<OsString>,
    shim: Option<Vec<OsString>>,
) -> Result<(PathBuf, Vec<OsString>), Failure> {
    let program = parts.program(name)?;
    let Some(shim) = shim else { return Ok((program, line)) };
    let below = ["--".into(), program.into()];
    Ok((parts.program("gleaner-shim")?, shim.into_iter().chain(below).chain(line).collect()))
}

fn follow<T: DeserializeOwned>(
    reports: impl Read,
    wrap: fn(T) -> ChildOutput,
    sender: &SyncSender<ChildOutput>,
) {
    let mut reports = BufReader::new(reports);
    let mut line = Vec::new();
    while next_report(&mut reports, &mut line).unwrap_or(false) {
        // A shim ends a line that its runtime left unfinished.
        if line == b"\n" {
            continue;
        }
        let unparsable = |_| {
            ChildOutput::Unparsable(visible(
                &String::from_utf8_lossy(&line).chars().take(200).collect::<String>(),
            ))
        };
        if sender.send(serde_json::from_slice(&line).map_or_else(unparsable, wrap)).is_err() {
            return;
        }
    }
}
