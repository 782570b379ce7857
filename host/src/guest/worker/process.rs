//! The worker as a process: started below `gleaner-shim`, read, and ended.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStderr, ChildStdout, Command, Stdio};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, each_piece};
use gleaner_parts::Parts;
use gleaner_protocol::ExitRecord;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::ioctl_fionbio;
use rustix::process::{Pid, Signal, kill_process};

use super::{MESSAGE_MAX, Message};

/// The argument that makes `gleaner-runtime` a worker; it comes first.
pub const WORKER: &str = "--worker";

/// How long a worker may take to end once that was requested. What it wrote to standard error may
/// take as long.
const UNTIL_KILLED: Duration = Duration::from_secs(2);
/// Bytes of standard error that are held while it is not known whether they come from the lambda.
const HELD: usize = 4 << 20;

/// A worker that was started.
pub(super) struct Process {
    shim: Child,
    /// None once they are not read any more.
    messages: Option<BufReader<Napping>>,
    line: Vec<u8>,
    /// How it ended, as the shim sent it last.
    record: Option<ExitRecord>,
    /// Receives, once, whether standard error may come from the lambda.
    is_ready: Sender<bool>,
    /// Receives whether the worker printed an error of our own, once its standard error has ended.
    passed_on: Receiver<bool>,
}

/// The reading end of the messages. It looks for them now and then and does not wait in the kernel,
/// where each message would have to wake it: of a lambda that does nothing, a replay made 135,000
/// wakes a second with such wake-ups, and 190,000 without.
struct Napping {
    messages: ChildStdout,
    /// Whether there may come more.
    waits: bool,
}

impl Napping {
    /// The first pause; each further one without a message is twice as long.
    const FIRST: Duration = Duration::from_micros(100);
    const LONGEST: Duration = Duration::from_millis(2);

    fn over(messages: ChildStdout) -> io::Result<Self> {
        ioctl_fionbio(&messages, true)?;
        Ok(Self { messages, waits: true })
    }
}

impl Read for Napping {
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
                // A long wake: one wake-up costs less than looking again and again. A signal may
                // end it early.
                let _ = poll(&mut [PollFd::new(&self.messages, PollFlags::IN)], None);
            }
        }
    }
}

/// How a worker ended.
pub(super) struct Ended {
    /// As the shim wrote it down, if it lived to do so.
    pub(super) record: Option<ExitRecord>,
    /// Exit code of the shim, which ends as its runtime does.
    pub(super) code: Option<i32>,
    /// This process has ended it.
    pub(super) was_forced: bool,
    /// Our own part of it printed why, before anything of the lambda could run.
    pub(super) is_explained: bool,
}

/// Why there is no further message.
pub(super) enum NoMessage {
    /// The process has ended, or has closed its standard output.
    Ended,
    /// The message is malformed.
    Malformed(String),
}

impl Process {
    /// Starts this program again as a worker, with `arguments` and those that this process was
    /// given.
    pub(super) fn start(arguments: Vec<OsString>) -> Result<Self, Failure> {
        let failed = |what: &str, error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, what, error)
        };
        let parts = Parts::find()?;
        let (shim, runtime) = (parts.program("gleaner-shim")?, parts.program("gleaner-runtime")?);
        let starter: OsString = format!("--starter={}", std::process::id()).into();
        let mut command = Command::new(&shim);
        command.arg(starter).args(["--exit-record", "-", "--"]);
        command.arg(runtime).arg(WORKER).args(arguments).args(std::env::args_os().skip(1));
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut shim = command
            .spawn()
            .map_err(|error| failed(&format!("cannot start `{}`", shim.display()), &error))?;
        let messages = Napping::over(shim.stdout.take().expect("it is piped"));
        let messages =
            messages.map_err(|error| failed("cannot read from the lambda's process", &error))?;
        let messages = Some(BufReader::with_capacity(1 << 16, messages));
        let (is_ready, decided) = mpsc::channel();
        let (end, passed_on) = mpsc::channel();
        let from = shim.stderr.take().expect("it is piped");
        thread::spawn(move || pass_on(from, &decided, &end));
        Ok(Self { shim, messages, line: Vec::new(), record: None, is_ready, passed_on })
    }

    /// Waits for the next message.
    pub(super) fn next(&mut self) -> Result<Message, NoMessage> {
        let Some(messages) = &mut self.messages else { return Err(NoMessage::Ended) };
        loop {
            self.line.clear();
            let read = messages.take(MESSAGE_MAX).read_until(b'\n', &mut self.line);
            // A process that is killed while it writes leaves a part of a message, which the shim
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
                Err(_) => NoMessage::Malformed(error.to_string()),
            }
        })
    }

    /// From now on what the process writes to standard error may come from the lambda: each line is
    /// marked as such.
    pub(super) fn ready(&self) {
        let _ = self.is_ready.send(true);
    }

    /// Ends the process, or with `patience` waits so long for its own end; returns how it ended.
    pub(super) fn end(mut self, patience: Duration) -> io::Result<Ended> {
        let _ = self.is_ready.send(false);
        if patience.is_zero() {
            // What it would still write could keep it, and its shim, from ending.
            self.messages = None;
        }
        let started = Instant::now();
        let (mut was_forced, mut is_killed) = (false, false);
        let status = loop {
            if let Some(status) = self.shim.try_wait()? {
                break status;
            }
            if !was_forced && started.elapsed() >= patience {
                was_forced = true;
                let _ = kill_process(Pid::from_child(&self.shim), Signal::TERM);
            }
            // Native code may ignore that. The runtime does not outlive its shim.
            if !is_killed && started.elapsed() >= patience + UNTIL_KILLED {
                is_killed = true;
                let _ = kill_process(Pid::from_child(&self.shim), Signal::KILL);
            }
            thread::sleep(Duration::from_millis(1));
        };
        // A process that the worker left behind may hold its standard error open.
        let is_explained = self.passed_on.recv_timeout(UNTIL_KILLED).unwrap_or(false);
        // The last line is the shim's, whatever the lambda wrote before. A pipe holds less than a
        // message may have.
        if let Some(messages) = &mut self.messages {
            messages.get_mut().waits = false;
            let mut rest = Vec::new();
            let _ = messages.take(MESSAGE_MAX).read_to_end(&mut rest);
            let last = rest.split(|byte| *byte == b'\n').rfind(|line| !line.is_empty());
            self.record = last.and_then(|line| serde_json::from_slice(line).ok()).or(self.record);
        }
        let record = self.record;
        Ok(Ended { record, code: status.code(), was_forced, is_explained })
    }
}

/// Passes on what a worker writes to standard error: as it is if the worker never became ready, and
/// else with a mark. Sends to `end` whether it was an error of our own.
fn pass_on(mut from: ChildStderr, is_ready: &Receiver<bool>, end: &Sender<bool>) {
    let mut held = Vec::new();
    // Nothing of the lambda has run until it is decided, and our own part writes no more than this.
    let mut piece = [0; 8192];
    let is_ready = loop {
        match from.read(&mut piece) {
            Ok(read @ 1..) if held.len() < HELD => held.extend_from_slice(&piece[..read]),
            Ok(read) => {
                held.extend_from_slice(&piece[..read]);
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
    let is_whole = each_piece(io::Cursor::new(held).chain(from), |piece| {
        is_explained |= mark.is_empty() && piece.is_failure();
        // In one write, so that no other line of this process comes between.
        let text = [if piece.begins_line { mark.as_bytes() } else { b"" }, piece.bytes].concat();
        let _ = io::stderr().write_all(&text);
    });
    if !is_whole {
        // Else the next line of this process would be a part of it.
        let _ = io::stderr().write_all(b"\n");
    }
    let _ = end.send(is_explained);
}
