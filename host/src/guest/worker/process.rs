//! The process of a worker: starts it below `gleaner-shim`, reads its messages, and ends it.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStderr, ChildStdout, Command, Stdio};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure, each_piece};
use gleaner_protocol::{ExitRecord, PASSES_INFERENCE};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::ioctl_fionbio;
use rustix::process::{Pid, Signal, kill_process};

use super::{MESSAGE_MAX, WorkerMessage};

/// The argument that makes `gleaner-runtime` a worker; it comes first.
pub const WORKER: &str = "--worker";

/// Time after SIGTERM until a worker is killed. Its standard error may take as long.
const UNTIL_KILLED: Duration = Duration::from_secs(2);
/// Bytes of standard error that are buffered until it is known whether they may come from the
/// lambda.
const BUFFERED_MAX: usize = 4 << 20;

pub(super) struct WorkerProcess {
    shim: Child,
    /// `None` once they are not read any more.
    messages: Option<BufReader<PollingReader>>,
    line: Vec<u8>,
    /// The exit record, which the shim sends last.
    record: Option<ExitRecord>,
    /// Receives, once, whether standard error may come from the lambda.
    is_ready: Sender<bool>,
    /// Receives whether the worker printed an error of Gleaner's own code, once its standard error
    /// has ended.
    is_explained: Receiver<bool>,
}

/// The reading end of the messages, which polls with pauses. A blocking read would be woken by each
/// message: with an empty lambda, a replay made 135,000 wakes a second with blocking reads, and
/// 190,000 without.
struct PollingReader {
    messages: ChildStdout,
    /// Set while further messages may come.
    waits: bool,
}

impl PollingReader {
    /// The first pause; each further one without a message is twice as long.
    const FIRST: Duration = Duration::from_micros(100);
    const LONGEST: Duration = Duration::from_millis(2);

    fn over(messages: ChildStdout) -> io::Result<Self> {
        ioctl_fionbio(&messages, true)?;
        Ok(Self { messages, waits: true })
    }
}

impl Read for PollingReader {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut pause = Self::FIRST;
        loop {
            match self.messages.read(into) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock && self.waits => {}
                read => return read,
            }
            if pause < Self::LONGEST {
                thread::sleep(pause);
                pause *= 2;
            } else {
                // A long wake: one blocking poll costs less than many pauses. A signal may end it
                // early.
                let _ = poll(&mut [PollFd::new(&self.messages, PollFlags::IN)], None);
            }
        }
    }
}

pub(super) struct WorkerExit {
    /// The record of the shim, if it could send one.
    pub(super) record: Option<ExitRecord>,
    /// Exit code of the shim, which ends as its runtime does.
    pub(super) code: Option<i32>,
    /// Set if this process has ended it.
    pub(super) was_forced: bool,
    /// Set if Gleaner's own code printed the error, before any code of the lambda could run.
    pub(super) is_explained: bool,
}

/// The reason why there is no further message.
pub(super) enum NoMessage {
    /// The process has ended, or has closed its standard output.
    Ended,
    Malformed(String),
}

impl WorkerProcess {
    /// Starts this program again as a worker, with `arguments` and those of this process.
    pub(super) fn start(arguments: Vec<OsString>) -> Result<Self, Failure> {
        let failed = |what: &str, error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, what, error)
        };
        let parts = InstalledPrograms::find()?;
        let (shim, runtime) = (parts.program("gleaner-shim")?, parts.program("gleaner-runtime")?);
        let starter: OsString = format!("--starter={}", std::process::id()).into();
        let mut command = Command::new(&shim);
        command.arg(starter).args(["--exit-record", "-", "--"]);
        command.arg(runtime).arg(WORKER).args(arguments).args(std::env::args_os().skip(1));
        // A starter that passes a connection to models passes it to this worker, over the standard
        // input that it shares with this process.
        let passing = format!("--{PASSES_INFERENCE}");
        let passes = std::env::args_os().any(|argument| argument == *passing);
        command
            .stdin(if passes { Stdio::inherit() } else { Stdio::null() })
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut shim = command
            .spawn()
            .map_err(|error| failed(&format!("cannot start `{}`", shim.display()), &error))?;
        let messages = PollingReader::over(shim.stdout.take().expect("it is piped"));
        let messages =
            messages.map_err(|error| failed("cannot read from the lambda's process", &error))?;
        let messages = Some(BufReader::with_capacity(1 << 16, messages));
        let (is_ready, decided) = mpsc::channel();
        let (end, is_explained) = mpsc::channel();
        let from = shim.stderr.take().expect("it is piped");
        thread::spawn(move || forward_stderr(from, &decided, &end));
        Ok(Self { shim, messages, line: Vec::new(), record: None, is_ready, is_explained })
    }

    pub(super) fn next(&mut self) -> Result<WorkerMessage, NoMessage> {
        let Some(messages) = &mut self.messages else { return Err(NoMessage::Ended) };
        loop {
            self.line.clear();
            let read = messages.take(MESSAGE_MAX).read_until(b'\n', &mut self.line);
            // A process that is killed while it writes leaves a partial message, which the shim
            // ends before its own.
            match (read, &*self.line) {
                (Ok(1..), b"\n") => {}
                (Ok(1..), line) if line.ends_with(b"\n") => break,
                (Ok(1..), line) if line.len() as u64 == MESSAGE_MAX => {
                    return Err(NoMessage::Malformed(format!(
                        "a message of more than {MESSAGE_MAX} bytes"
                    )));
                }
                _ => return Err(NoMessage::Ended),
            }
        }
        serde_json::from_slice(&self.line).map_err(|error| {
            match serde_json::from_slice(&self.line) {
                Ok(record) => {
                    self.record = Some(record);
                    NoMessage::Ended
                }
                Err(_) => NoMessage::Malformed(format!("a malformed message ({error})")),
            }
        })
    }

    /// Marks each further line of the process's standard error as possible output of the lambda.
    pub(super) fn ready(&self) {
        let _ = self.is_ready.send(true);
    }

    /// Waits at most `timeout` for the process to end, then ends it; returns its exit.
    pub(super) fn end(mut self, timeout: Duration) -> io::Result<WorkerExit> {
        let _ = self.is_ready.send(false);
        if timeout.is_zero() {
            // A full pipe could keep the process, and its shim, from ending.
            self.messages = None;
        }
        let started = Instant::now();
        let (mut was_forced, mut is_killed) = (false, false);
        let status = loop {
            if let Some(status) = self.shim.try_wait()? {
                break status;
            }
            if !was_forced && started.elapsed() >= timeout {
                was_forced = true;
                let _ = kill_process(Pid::from_child(&self.shim), Signal::TERM);
            }
            // Native code may ignore that. The runtime does not outlive its shim.
            if !is_killed && started.elapsed() >= timeout + UNTIL_KILLED {
                is_killed = true;
                let _ = kill_process(Pid::from_child(&self.shim), Signal::KILL);
            }
            thread::sleep(Duration::from_millis(1));
        };
        // An orphan of the worker may hold its standard error open.
        let is_explained = self.is_explained.recv_timeout(UNTIL_KILLED).unwrap_or(false);
        // The last line is the shim's, whatever the lambda wrote before. A pipe holds less than the
        // maximum of a message.
        if let Some(messages) = &mut self.messages {
            messages.get_mut().waits = false;
            let mut rest = Vec::new();
            let _ = messages.take(MESSAGE_MAX).read_to_end(&mut rest);
            let last = rest.split(|byte| *byte == b'\n').rfind(|line| !line.is_empty());
            self.record = last.and_then(|line| serde_json::from_slice(line).ok()).or(self.record);
        }
        let record = self.record;
        Ok(WorkerExit { record, code: status.code(), was_forced, is_explained })
    }
}

/// Forwards a worker's standard error: unchanged if the worker never became ready, otherwise with a
/// mark. Sends to `end` whether it was an error of Gleaner's own code.
fn forward_stderr(mut from: ChildStderr, is_ready: &Receiver<bool>, end: &Sender<bool>) {
    let mut buffered = Vec::new();
    // No code of the lambda runs before this is decided, and Gleaner's own code writes less than
    // this.
    let mut piece = [0; 8192];
    let is_ready = loop {
        match from.read(&mut piece) {
            Ok(read @ 1..) if buffered.len() < BUFFERED_MAX => {
                buffered.extend_from_slice(&piece[..read])
            }
            Ok(read) => {
                buffered.extend_from_slice(&piece[..read]);
                break is_ready.recv();
            }
            Err(_) => break is_ready.recv(),
        }
        if let Ok(decided) = is_ready.try_recv() {
            break Ok(decided);
        }
    };
    let mark = if is_ready == Ok(true) { "lambda: " } else { "" };
    let mut is_explained = false;
    let is_whole = each_piece(io::Cursor::new(buffered).chain(from), |piece| {
        is_explained |= mark.is_empty() && piece.is_failure();
        // In one write, so that no other line of this process is mixed in.
        let text = [if piece.begins_line { mark.as_bytes() } else { b"" }, piece.bytes].concat();
        let _ = io::stderr().write_all(&text);
    });
    if !is_whole {
        // Otherwise the next line of this process would continue it.
        let _ = io::stderr().write_all(b"\n");
    }
    let _ = end.send(is_explained);
}
