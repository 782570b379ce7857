//! One process of a run.

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
use gleaner_protocol::UNTIL_KILLED;
use rustix::process::{Pid, Signal, kill_process};
use serde::de::DeserializeOwned;

use super::LOOK;
use super::ear::{Ear, Heard};
use super::screen::Screen;
use crate::runtime::next_report;

/// How long a process may take for its end: a wake that runs, clips that are completed. A shim ends
/// its runtime before.
const PATIENCE: Duration = UNTIL_KILLED.saturating_add(Duration::from_secs(10));

/// A program of ours that reports.
pub(super) struct Process {
    name: &'static str,
    child: Child,
}

impl Process {
    /// Starts it; its reports are `T`, and are heard as `heard` says. With `shim`, arguments of
    /// gleaner-shim, it is a runtime.
    pub(super) fn start<T: DeserializeOwned + 'static>(
        parts: &Parts,
        name: &'static str,
        line: Vec<OsString>,
        stdin: Option<OwnedFd>,
        shim: Option<Vec<OsString>>,
        heard: fn(T) -> Heard,
        say: &SyncSender<Heard>,
    ) -> Result<Self, Failure> {
        let (program, line) = watched(parts, name, line, shim)?;
        let mut child = Command::new(&program)
            .args(line)
            // Ctrl-C is for us: we end them in order.
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
            let say = say.clone();
            thread::spawn(move || follow(reports, heard, &say));
        }
        if let Some(says) = child.stderr.take() {
            let say = say.clone();
            let pass_on = move |piece: &[u8]| drop(say.send(Heard::Said(piece.to_vec())));
            thread::spawn(move || crate::runtime::pass_on(says, &AtomicBool::new(false), pass_on));
        }
        Ok(Self { name, child })
    }

    /// How it ended, if it has.
    pub(super) fn status(&mut self) -> Result<Option<ExitStatus>, Failure> {
        let failed = |error| {
            Failure::caused_by(Exit::Internal, format!("cannot wait for {}", self.name), &error)
        };
        self.child.try_wait().map_err(failed)
    }

    /// Asks it to end, and waits for that.
    pub(super) fn end(
        &mut self,
        ear: &mut Ear,
        screen: &mut Screen,
    ) -> Result<ExitStatus, Failure> {
        self.tell(Signal::TERM);
        self.wait(ear, screen)
    }

    /// Waits for its end, and forces it in the end.
    pub(super) fn wait(
        &mut self,
        ear: &mut Ear,
        screen: &mut Screen,
    ) -> Result<ExitStatus, Failure> {
        let mut asked = Instant::now();
        loop {
            ear.look(screen, LOOK);
            if let Some(status) = self.status()? {
                return Ok(status);
            }
            if asked.elapsed() > PATIENCE {
                screen.warn(&format!(
                    "{} did not end when it was asked to, and is killed",
                    self.name
                ));
                self.tell(Signal::KILL);
                asked = Instant::now();
            }
        }
    }

    fn tell(&self, signal: Signal) {
        // One that has just ended is not there to be told, which is as good.
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, signal);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Only where an error kept us from waiting for it.
        if let Ok(None) = self.child.try_wait() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// The program to start and its arguments: `name` itself, or the shim that starts it.
fn watched(
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

fn follow<T: DeserializeOwned>(reports: impl Read, heard: fn(T) -> Heard, say: &SyncSender<Heard>) {
    let mut reports = BufReader::new(reports);
    let mut line = Vec::new();
    while next_report(&mut reports, &mut line).unwrap_or(false) {
        // A shim ends the line that its runtime may have begun.
        if line == b"\n" {
            continue;
        }
        let garbled = |_| {
            Heard::Garbled(visible(
                &String::from_utf8_lossy(&line).chars().take(200).collect::<String>(),
            ))
        };
        if say.send(serde_json::from_slice(&line).map_or_else(garbled, heard)).is_err() {
            return;
        }
    }
}
