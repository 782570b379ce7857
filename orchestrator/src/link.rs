//! The connection to the supervisor: starts it if none runs, sends it what is wanted, and receives
//! its status.
//!
//! The supervisor and all lambdas go on while the orchestrator does not run. Its lock shows whether
//! one runs, whatever became of its socket.

use std::fs::{self, File};
use std::io::{Read, Seek, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure, chain};
use gleaner_protocol::supervision::{
    EventKind, SUPERVISION_VERSION, SupervisionSpec, SupervisorReport, SupervisorRequest,
};
use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::OwnedWriteHalf;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};

use crate::orchestrator::Orchestrator;

/// Maximum length of a report, in bytes.
const REPORT_MAX: u64 = 16 << 20;
/// Time without a report after which the connection is made again; one comes each second.
const SILENCE: Duration = Duration::from_secs(10);
/// Time to connect to a supervisor that runs; afterwards its socket is lost, and it is ended.
const CONNECT: Duration = Duration::from_secs(5);
/// Pause between two attempts; it doubles up to the longest while a supervisor does not stay.
const PAUSE: Duration = Duration::from_millis(100);
const PAUSE_MAX: Duration = Duration::from_secs(10);
/// Time after which a connection was one to a supervisor that stays.
const STAYS: Duration = Duration::from_secs(1);
/// Number of connections in a row without any report after which the supervisor hangs, and is
/// ended.
const SILENT_MAX: u32 = 3;
/// Time for the supervisor to end all processes.
const END: Duration = Duration::from_secs(60);

pub(crate) struct SupervisorLink {
    pub(crate) core: Arc<Orchestrator>,
    pub(crate) spec: SupervisionSpec,
    pub(crate) stop: watch::Receiver<bool>,
}

enum LinkEnd {
    /// The supervisor has ended, as requested.
    Stopped,
    /// It must be started again, for this reason: it runs with other settings.
    Outdated(String),
    Lost(String),
    /// It has not reported for [`SILENCE`].
    Silent,
}

impl SupervisorLink {
    /// Keeps a supervisor running until `stop` is set; then ends it. A failure if it does not end
    /// in time.
    pub(crate) async fn keep(self) -> Result<(), Failure> {
        self.adopt();
        let (mut is_failing, mut pause, mut silent) = (false, PAUSE, 0);
        loop {
            let connected = tokio::time::Instant::now();
            let end = match self.connect().await {
                Ok(stream) => self.serve(stream).await,
                Err(failure) => LinkEnd::Lost(failure.to_string()),
            };
            self.core.lock().status = None;
            silent = if matches!(end, LinkEnd::Silent) { silent + 1 } else { 0 };
            if silent == 0 && connected.elapsed() >= STAYS {
                (is_failing, pause) = (false, PAUSE);
            }
            match end {
                LinkEnd::Stopped => return self.wait_for_end().await,
                LinkEnd::Outdated(reason) => {
                    let text = format!("the supervisor is started again: {reason}");
                    self.core.warn(&text);
                    self.end_by_signal().await?;
                }
                LinkEnd::Silent if silent >= SILENT_MAX => {
                    silent = 0;
                    let text = "the supervisor hangs, and is ended";
                    self.core.event(EventKind::Failed, None, text);
                    self.end_by_signal().await?;
                }
                LinkEnd::Silent => {
                    if *self.stop.borrow() {
                        return self.end_by_signal().await;
                    }
                }
                LinkEnd::Lost(reason) => {
                    if !std::mem::replace(&mut is_failing, true) {
                        let text = format!("the supervisor is lost: {reason}");
                        self.core.event(EventKind::Failed, None, &text);
                    }
                    if *self.stop.borrow() {
                        return self.end_by_signal().await;
                    }
                    sleep(pause).await;
                    pause = PAUSE_MAX.min(2 * pause);
                }
            }
        }
    }

    /// Waits, in a thread, for the end of a supervisor that this process started before SIGHUP, as
    /// another program: it stays its child.
    fn adopt(&self) {
        if let Ok((mut lock, false)) = self.core.layout.supervisor_lock()
            && let Some(pid) = supervisor(&mut lock)
        {
            // An error means that another process has started it, which then waits for it.
            std::thread::spawn(move || waitpid(Some(pid), WaitOptions::empty()));
        }
    }

    async fn connect(&self) -> Result<UnixStream, Failure> {
        let path = self.core.layout.supervisor_socket();
        let until = tokio::time::Instant::now() + CONNECT;
        loop {
            let (lock, is_free) = self.core.layout.supervisor_lock()?;
            if is_free {
                self.start(lock)?;
            }
            match UnixStream::connect(&path).await {
                Ok(stream) => return Ok(stream),
                Err(error) if tokio::time::Instant::now() >= until => {
                    self.end_by_signal().await?;
                    let action = format!("cannot connect to `{}`", path.display());
                    return Err(Failure::caused_by(Exit::Unreachable, action, &error));
                }
                Err(_) => sleep(PAUSE).await,
            }
        }
    }

    /// Starts a supervisor. It inherits the lock, and begins a session of its own.
    fn start(&self, mut lock: File) -> Result<(), Failure> {
        let program = InstalledPrograms::find()?.program("gleaner-supervisor")?;
        let failed = |error: std::io::Error| {
            let action = format!("cannot start `{}`", program.display());
            Failure::caused_by(Exit::Internal, action, &error)
        };
        let path = self.core.layout.supervisor_socket();
        // Of a supervisor that has ended: none has the lock.
        let _ = fs::remove_file(&path);
        let listener = UnixListener::bind(&path).map_err(failed)?;
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).map_err(failed)?;
        lock.set_len(0).map_err(failed)?;
        let held = lock.try_clone().map_err(failed)?;
        let mut command = Command::new(&program);
        command
            .env("XDG_CACHE_HOME", self.core.layout.cache())
            .stdin(OwnedFd::from(listener))
            .stdout(OwnedFd::from(held));
        let mut child = command.spawn().map_err(failed)?;
        lock.rewind().and_then(|()| write!(lock, "{}", child.id())).map_err(failed)?;
        // It may outlive this process; while both run, its end is waited for here.
        std::thread::spawn(move || drop(child.wait()));
        Ok(())
    }

    async fn serve(&self, stream: UnixStream) -> LinkEnd {
        let (mut desired, mut stop) = (self.core.desired(), self.stop.clone());
        let (reader, mut writer) = stream.into_split();
        let mut reader = BufReader::new(reader);
        let configure = SupervisorRequest::Configure(Box::new(self.spec.clone()));
        if let Err(error) = send(&mut writer, &configure).await {
            return LinkEnd::Lost(error.to_string());
        }
        desired.mark_changed();
        let mut line = Vec::new();
        loop {
            let mut limited = (&mut reader).take(REPORT_MAX.saturating_sub(line.len() as u64));
            tokio::select! {
                // A read that is cancelled keeps what it has read in `line`.
                read = timeout(SILENCE, limited.read_until(b'\n', &mut line)) => {
                    match read {
                        Err(_) => return LinkEnd::Silent,
                        Ok(Err(error)) => return LinkEnd::Lost(error.to_string()),
                        Ok(Ok(_)) if !line.ends_with(b"\n") => {
                            return LinkEnd::Lost("it closed the connection".to_owned());
                        }
                        Ok(Ok(_)) => {}
                    }
                    if let Some(end) = self.report(&line) {
                        return end;
                    }
                    line.clear();
                }
                changed = desired.changed() => {
                    if changed.is_err() {
                        return LinkEnd::Lost("the orchestrator ends".to_owned());
                    }
                    let state = desired.borrow_and_update().clone();
                    let apply = SupervisorRequest::Apply(Box::new(state));
                    if let Err(error) = send(&mut writer, &apply).await {
                        return LinkEnd::Lost(error.to_string());
                    }
                }
                () = is_set(&mut stop) => {
                    return match send(&mut writer, &SupervisorRequest::Stop).await {
                        Ok(()) => LinkEnd::Stopped,
                        Err(error) => LinkEnd::Lost(error.to_string()),
                    };
                }
            }
        }
    }

    fn report(&self, line: &[u8]) -> Option<LinkEnd> {
        match serde_json::from_slice(line) {
            Ok(SupervisorReport::Welcome(welcome)) if welcome.version != SUPERVISION_VERSION => {
                let (found, wanted) = (welcome.version, SUPERVISION_VERSION);
                Some(LinkEnd::Outdated(format!("it has version {found}, this one {wanted}")))
            }
            Ok(SupervisorReport::Welcome(_)) => None,
            Ok(SupervisorReport::OtherSettings) => {
                Some(LinkEnd::Outdated("it runs with other settings".to_owned()))
            }
            Ok(SupervisorReport::Replaced) => {
                Some(LinkEnd::Outdated("the programs were replaced".to_owned()))
            }
            Ok(SupervisorReport::Refused { reason }) => {
                let text = format!("the supervisor refuses a request: {reason}");
                self.core.warn(&text);
                None
            }
            Ok(SupervisorReport::Status(status)) => {
                self.core.observe(*status);
                None
            }
            Err(error) => Some(LinkEnd::Outdated(chain(&error))),
        }
    }

    /// Ends the supervisor by SIGTERM, if one runs.
    async fn end_by_signal(&self) -> Result<(), Failure> {
        let (mut lock, is_free) = self.core.layout.supervisor_lock()?;
        if is_free {
            return Ok(());
        }
        let pid = supervisor(&mut lock);
        if let Some(pid) = pid {
            let _ = kill_process(pid, Signal::TERM);
        }
        let ended = self.wait_for_end().await;
        if let (Some(pid), true) = (pid.filter(|pid| is_supervisor(*pid)), ended.is_err()) {
            let _ = kill_process(pid, Signal::KILL);
            return self.wait_for_end().await;
        }
        ended
    }

    async fn wait_for_end(&self) -> Result<(), Failure> {
        let ended = timeout(END, async {
            loop {
                match self.core.layout.supervisor_lock() {
                    Ok((_, false)) => sleep(PAUSE).await,
                    other => return other.map(|_| ()),
                }
            }
        });
        ended.await.unwrap_or_else(|_| {
            let message = "gleaner-supervisor did not end within a minute".to_owned();
            Err(Failure::new(Exit::Internal, message))
        })
    }
}

/// Returns the process that has this lock.
fn supervisor(lock: &mut File) -> Option<Pid> {
    let mut text = String::new();
    lock.take(16).read_to_string(&mut text).ok()?;
    text.trim().parse().ok().and_then(Pid::from_raw).filter(|pid| is_supervisor(*pid))
}

/// Returns whether a process is a supervisor: the number in the file of the lock may be an old one.
fn is_supervisor(pid: Pid) -> bool {
    let program = fs::read_link(format!("/proc/{}/exe", pid.as_raw_nonzero()));
    let name = program.ok().and_then(|it| Some(it.file_name()?.to_str()?.to_owned()));
    // The kernel marks a program that was replaced on the disk.
    name.is_some_and(|name| name.trim_end_matches(" (deleted)") == "gleaner-supervisor")
}

async fn is_set(stop: &mut watch::Receiver<bool>) {
    // An error means that the sender is gone: this program is replaced after SIGHUP, and the
    // supervisor must go on.
    if stop.wait_for(|stop| *stop).await.is_err() {
        std::future::pending::<()>().await;
    }
}

async fn send(writer: &mut OwnedWriteHalf, request: &SupervisorRequest) -> std::io::Result<()> {
    let mut text = serde_json::to_vec(request).expect("a request is plain data");
    text.push(b'\n');
    writer.write_all(&text).await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_that_is_replaced_does_not_end_the_supervisor() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let (sender, mut stop) = watch::channel(false);
            let short = Duration::from_millis(20);
            sender.send_replace(true);
            timeout(short, is_set(&mut stop)).await.expect("it is set");
            let (sender, mut stop) = watch::channel(false);
            drop(sender);
            timeout(short, is_set(&mut stop)).await.expect_err("it was never set");
        });
    }
}
