//! The worker as a process: started below `gleaner-shim`, read, and ended.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStderr, ChildStdout, Command, Stdio};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_protocol::{Exit, ExitRecord, Failure, Parts};
use rustix::io::ioctl_fionbio;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

use super::{MESSAGE_MAX, Message};

/// The argument that makes `gleaner-runtime` a worker; it comes first.
pub const WORKER: &str = "--worker";

/// How long a worker may take to end by itself once its last message was read. What it wrote to standard error may take as long.
const UNTIL_ENDED: Duration = Duration::from_secs(2);

/// A worker that was started.
pub(super) struct Process {
    shim: Child,
    messages: BufReader<Napping>,
    line: Vec<u8>,
    folder: TempDir,
    /// Whether what the worker writes to standard error is to be marked as the lambda's; decided once.
    is_ready: Sender<bool>,
    /// Whether it said why it failed; sent when all of it was passed on.
    passed_on: Receiver<bool>,
}

/// The reading end of the messages. It looks for them now and then and does not wait in the kernel, where each message would have to
/// wake it: of a lambda that does nothing, a replay made 135,000 wakes a second with such wake-ups, and 190,000 without.
struct Napping(ChildStdout);

impl Napping {
    /// The first pause; each further one without a message is twice as long.
    const FIRST: Duration = Duration::from_micros(100);
    const LONGEST: Duration = Duration::from_millis(2);

    fn over(messages: ChildStdout) -> io::Result<Self> {
        ioctl_fionbio(&messages, true)?;
        Ok(Self(messages))
    }
}

impl Read for Napping {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut pause = Self::FIRST;
        loop {
            match self.0.read(into) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => thread::sleep(pause),
                read => return read,
            }
            pause = (2 * pause).min(Self::LONGEST);
        }
    }
}

/// How a worker ended.
pub(super) struct Ended {
    pub(super) record: ExitRecord,
    /// Whether our own part of it printed why, before anything of the lambda could.
    pub(super) is_explained: bool,
}

/// Why there is no further message.
pub(super) enum NoMessage {
    /// The process has ended, or has closed its standard output.
    Ended,
    /// There is one that no worker sends.
    Malformed(String),
}

impl Process {
    /// Starts this program again as a worker, with `arguments` and those that this process was given.
    pub(super) fn start(arguments: Vec<OsString>) -> Result<Self, Failure> {
        let failed = |what: &str, error: &dyn std::error::Error| Failure::caused_by(Exit::Internal, what, error);
        let parts = Parts::find()?;
        let (shim, runtime) = (parts.program("gleaner-shim")?, parts.program("gleaner-runtime")?);
        let folder = tempfile::tempdir().map_err(|error| failed("cannot make a temporary folder", &error))?;
        let starter: OsString = format!("--starter={}", std::process::id()).into();
        let mut command = Command::new(&shim);
        command.arg(starter).arg("--exit-record").arg(folder.path().join(ExitRecord::FILE)).arg("--");
        command.arg(runtime).arg(WORKER).args(arguments).args(std::env::args_os().skip(1));
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut shim =
            command.spawn().map_err(|error| failed(&format!("cannot start `{}`", shim.display()), &error))?;
        let messages = Napping::over(shim.stdout.take().expect("it is piped"));
        let messages = messages.map_err(|error| failed("cannot read from the lambda's process", &error))?;
        let messages = BufReader::with_capacity(1 << 16, messages);
        let (is_ready, decided) = mpsc::channel();
        let (end, passed_on) = mpsc::channel();
        let from = shim.stderr.take().expect("it is piped");
        thread::spawn(move || pass_on(from, &decided, &end));
        Ok(Self { shim, messages, line: Vec::new(), folder, is_ready, passed_on })
    }

    /// Waits for the next message.
    pub(super) fn next(&mut self) -> Result<Message, NoMessage> {
        self.line.clear();
        let read = (&mut self.messages).take(MESSAGE_MAX).read_until(b'\n', &mut self.line);
        if !matches!(read, Ok(1..)) {
            return Err(NoMessage::Ended);
        }
        if !self.line.ends_with(b"\n") && self.line.len() as u64 == MESSAGE_MAX {
            return Err(NoMessage::Malformed(format!("a message of more than {MESSAGE_MAX} bytes")));
        }
        // A process that is killed while it writes leaves a part of a message.
        if !self.line.ends_with(b"\n") {
            return Err(NoMessage::Ended);
        }
        serde_json::from_slice(&self.line).map_err(|error| NoMessage::Malformed(error.to_string()))
    }

    /// From now on what the process writes to standard error may come from the lambda: each line is marked as such.
    pub(super) fn ready(&self) {
        let _ = self.is_ready.send(true);
    }

    /// Ends the process if it has not ended by itself; returns how it ended. With `at_once` it is not given the time for that.
    pub(super) fn end(mut self, at_once: bool) -> io::Result<Ended> {
        let _ = self.is_ready.send(false);
        let asked = Instant::now();
        let mut is_killed = at_once;
        if at_once {
            self.ask_to_end();
        }
        // The shim ends with its runtime, which it kills where it has to.
        while self.shim.try_wait()?.is_none() {
            if !is_killed && asked.elapsed() >= UNTIL_ENDED {
                is_killed = true;
                self.ask_to_end();
            }
            thread::sleep(Duration::from_millis(1));
        }
        // A process that the worker left behind may hold its standard error open.
        let is_explained = self.passed_on.recv_timeout(UNTIL_ENDED).unwrap_or(false);
        let record = ExitRecord::read(&self.folder.path().join(ExitRecord::FILE))?;
        Ok(Ended { record, is_explained })
    }

    fn ask_to_end(&self) {
        let _ = kill_process(Pid::from_child(&self.shim), Signal::TERM);
    }
}

/// Passes on what a worker writes to standard error, as it is if the worker never became ready. Sends to `end` whether it was an error
/// of our own then.
fn pass_on(from: ChildStderr, is_ready: &Receiver<bool>, end: &Sender<bool>) {
    // Longest piece of a line that is held.
    const PIECE: u64 = 8192;
    // Until it is known who writes, nothing is read: the pipe holds what our own part of the process writes before it is ready.
    let mark = if is_ready.recv() == Ok(true) { "lambda: " } else { "" };
    let (mut from, mut piece) = (BufReader::new(from), Vec::new());
    let (mut begins_line, mut is_explained) = (true, false);
    while matches!((&mut from).take(PIECE).read_until(b'\n', &mut piece), Ok(1..)) {
        is_explained |= begins_line && mark.is_empty() && piece.starts_with(b"error: ");
        let mut text = if begins_line { mark.as_bytes().to_vec() } else { Vec::new() };
        text.append(&mut piece);
        begins_line = text.ends_with(b"\n");
        let _ = io::stderr().write_all(&text);
    }
    let _ = end.send(is_explained);
}
