//! `gleaner run` as a process that a test starts, hears out, and ends; and the player that gives it
//! something to hear.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_lambda::Decision;
use gleaner_protocol::link::RecorderReport;
use gleaner_protocol::{Live, Report};

use crate::{program, root};

/// How long anything may take: far longer than it does, so that only what hangs is caught.
pub const PATIENCE: Duration = Duration::from_secs(90);

/// A line that `gleaner run --json` prints.
#[derive(Debug)]
pub enum Line {
    /// Of the lambda.
    Lambda(Report),
    /// Of the recorder.
    Recorder(RecorderReport),
}

/// A program that was started, and is ended with this.
pub struct Started {
    child: Child,
    lines: Receiver<String>,
    errors: Receiver<String>,
}

/// Why there is no player here; `None` if there is one.
pub fn no_player() -> Option<&'static str> {
    player().is_none().then_some("no gleaner-player; run: cargo xtask player")
}

fn player() -> Option<PathBuf> {
    let player = program("gleaner").with_file_name("gleaner-player");
    player.is_file().then_some(player)
}

/// `gleaner run` of a built lambda, reporting as JSON.
pub fn run(lambda: &Path, out: &Path, args: &[&str]) -> Started {
    let mut gleaner = Command::new(program("gleaner"));
    gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache"));
    gleaner.arg("run").arg(lambda).arg("--json").arg("--out").arg(out).args(args);
    Started::start(gleaner)
}

/// `gleaner play`, with a summary as JSON.
pub fn play(args: &[&str]) -> Started {
    let mut player = Command::new(player().expect("asked before whether there is a player"));
    player.arg("--json").args(args);
    Started::start(player)
}

impl Started {
    /// Starts `command`.
    ///
    /// # Panics
    ///
    /// If it cannot be started.
    pub fn start(mut command: Command) -> Self {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("a program of ours starts");
        let lines = heard(child.stdout.take().expect("it was asked for"));
        let errors = heard(child.stderr.take().expect("it was asked for"));
        Self { child, lines, errors }
    }

    /// Its process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends it a signal, by name.
    pub fn signal(&self, name: &str) {
        signal(self.pid(), name);
    }

    /// The first line of its reports, from now on, of which `wanted` makes something.
    ///
    /// # Panics
    ///
    /// If it ends before, or takes longer than [`PATIENCE`].
    pub fn until<T>(&self, what: &str, mut wanted: impl FnMut(Line) -> Option<T>) -> T {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.lines.recv_timeout(left) {
                Ok(line) => {
                    if let Some(found) = parsed(&line).and_then(&mut wanted) {
                        return found;
                    }
                }
                Err(error) => panic!("waiting for {what}: {error}; it said\n{}", self.said()),
            }
        }
    }

    /// Waits until the lambda has had its `init`.
    pub fn until_ready(&self) {
        self.until("the lambda to be ready", |line| {
            matches!(line, Line::Lambda(Report::Ready)).then_some(())
        });
    }

    /// Waits for a status of the lambda that is as `wanted`.
    pub fn until_live(&self, what: &str, mut wanted: impl FnMut(&Live) -> bool) -> Live {
        self.until(what, |line| match line {
            Line::Lambda(Report::Live(live)) if wanted(&live) => Some(*live),
            _ => None,
        })
    }

    /// What it has said to people since the last call.
    pub fn said(&self) -> String {
        self.errors.try_iter().collect::<Vec<_>>().join("\n")
    }

    /// The rest of its reports, once it has ended by itself.
    ///
    /// # Panics
    ///
    /// If it takes longer than [`PATIENCE`].
    pub fn finish(mut self) -> Finished {
        let deadline = Instant::now() + PATIENCE;
        let mut lines = Vec::new();
        while let Ok(line) =
            self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now()))
        {
            lines.push(line);
        }
        let status = loop {
            match self.child.try_wait().expect("a child of ours can be waited for") {
                Some(status) => break status,
                None if Instant::now() > deadline => {
                    panic!("it does not end; it said\n{}", self.said())
                }
                None => thread::sleep(Duration::from_millis(10)),
            }
        };
        Finished { status, lines, said: self.said() }
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        if let Ok(None) = self.child.try_wait() {
            // In order; its own children end with it in any case.
            self.signal("TERM");
            let deadline = Instant::now() + Duration::from_secs(5);
            while Instant::now() < deadline && matches!(self.child.try_wait(), Ok(None)) {
                thread::sleep(Duration::from_millis(10));
            }
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// How a program ended, and what it reported since it was last listened to.
pub struct Finished {
    /// Its exit status.
    pub status: ExitStatus,
    /// Its reports.
    pub lines: Vec<String>,
    /// What it said to people.
    pub said: String,
}

impl Finished {
    /// How the lambda was, at the end.
    ///
    /// # Panics
    ///
    /// If it did not say.
    pub fn ended(&self) -> Live {
        let ended = self.lines.iter().filter_map(|line| parsed(line)).find_map(|line| match line {
            Line::Lambda(Report::Ended(live)) => Some(*live),
            _ => None,
        });
        ended.unwrap_or_else(|| panic!("no last report; {}, it said\n{}", self.status, self.said))
    }
}

/// Sends a signal to one process.
///
/// # Panics
///
/// If `kill` cannot be run.
pub fn signal(pid: u32, name: &str) {
    // It may have ended just now.
    let _ = Command::new("kill")
        .arg(format!("-{name}"))
        .arg(pid.to_string())
        .stderr(Stdio::null())
        .status();
}

/// The processes below `of` whose command line contains `name`.
pub fn below(of: u32, name: &str) -> Vec<u32> {
    let text =
        std::fs::read_to_string(format!("/proc/{of}/task/{of}/children")).unwrap_or_default();
    let is_called = |pid: u32| {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        // Python, too, has our program's name in its arguments no more; it has `start.py`.
        String::from_utf8_lossy(&line).contains(name)
    };
    let children = text.split_whitespace().filter_map(|pid| pid.parse().ok());
    children
        .flat_map(|pid| is_called(pid).then_some(pid).into_iter().chain(below(pid, name)))
        .collect()
}

/// The decisions in a folder of results.
pub fn decisions(out: &Path) -> Vec<Decision> {
    let text = std::fs::read_to_string(out.join("decisions.jsonl")).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).expect("a line is a decision")).collect()
}

fn parsed(line: &str) -> Option<Line> {
    let lambda = serde_json::from_str(line).map(Line::Lambda);
    lambda.or_else(|_| serde_json::from_str(line).map(Line::Recorder)).ok()
}

fn heard(stream: impl std::io::Read + Send + 'static) -> Receiver<String> {
    let (say, heard) = mpsc::channel();
    thread::spawn(move || {
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            if say.send(line).is_err() {
                return;
            }
        }
    });
    heard
}
