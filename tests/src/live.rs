//! Starts `gleaner run` and `gleaner play` as processes, reads their reports, and stops them.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_lambda::Decision;
use gleaner_protocol::ingress::IngressReport;
use gleaner_protocol::link::RecorderReport;
use gleaner_protocol::{LiveStatus, Report};

use crate::{find_program, program, root};

/// Maximum wait for anything: far longer than needed, so that only a hang reaches it.
pub const PATIENCE: Duration = Duration::from_secs(90);

/// A line that `gleaner run --json` prints.
#[derive(Debug)]
pub enum JsonReport {
    Lambda(Report),
    Recorder(RecorderReport),
    Ingress(IngressReport),
}

/// A running program, stopped on drop.
pub struct RunningProgram {
    child: Child,
    lines: Receiver<String>,
    errors: Receiver<String>,
}

/// The reason why there is no player; `None` if there is one.
pub fn no_player() -> Option<&'static str> {
    player().is_none().then_some("no gleaner-player; run: cargo xtask player")
}

fn player() -> Option<PathBuf> {
    find_program("gleaner-player")
}

/// Starts `gleaner run` with a built lambda, reporting as JSON.
pub fn run(lambda: &Path, out: &Path, args: &[&str]) -> RunningProgram {
    run_all(&[lambda], out, args)
}

/// Starts `gleaner run` with built lambdas, reporting as JSON.
pub fn run_all(lambdas: &[&Path], out: &Path, args: &[&str]) -> RunningProgram {
    run_by(Command::new(program("gleaner")), lambdas, out, args)
}

/// Starts `gleaner run` as [`run_all`] does, by a command that ends with the program.
pub fn run_by(
    mut gleaner: Command,
    lambdas: &[&Path],
    out: &Path,
    args: &[&str],
) -> RunningProgram {
    gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache"));
    gleaner.arg("run").args(lambdas).arg("--json").arg("--out").arg(out).args(args);
    RunningProgram::start(gleaner)
}

/// Starts `gleaner play`, with its summary as JSON.
pub fn play(args: &[&str]) -> RunningProgram {
    let mut player = Command::new(player().expect("the caller has checked `no_player`"));
    player.arg("--json").args(args);
    RunningProgram::start(player)
}

impl RunningProgram {
    /// Starts `command`.
    pub fn start(mut command: Command) -> Self {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("the program starts");
        let lines = lines_of(child.stdout.take().expect("stdout is a pipe"));
        let errors = lines_of(child.stderr.take().expect("stderr is a pipe"));
        Self { child, lines, errors }
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends it the signal `name`.
    pub fn signal(&self, name: &str) {
        signal(self.pid(), name);
    }

    /// Waits for the first further report for which `wanted` returns a value.
    pub fn until<T>(&self, what: &str, mut wanted: impl FnMut(JsonReport) -> Option<T>) -> T {
        self.until_line(what, |line| parsed(line).and_then(&mut wanted))
    }

    /// As [`until`](Self::until), for reports of several lambdas, with the name of each.
    pub fn until_named<T>(
        &self,
        what: &str,
        mut wanted: impl FnMut(String, Report) -> Option<T>,
    ) -> T {
        self.until_line(what, |line| {
            named(line).and_then(|(lambda, report)| wanted(lambda, report))
        })
    }

    /// As [`until`](Self::until), for lines of any kind.
    pub fn until_line<T>(&self, what: &str, mut wanted: impl FnMut(&str) -> Option<T>) -> T {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.lines.recv_timeout(left) {
                Ok(line) => {
                    if let Some(found) = wanted(&line) {
                        return found;
                    }
                }
                Err(error) => panic!("waiting for {what}: {error}; stderr:\n{}", self.stderr()),
            }
        }
    }

    /// Waits until the `init` of the lambda has returned.
    pub fn until_ready(&self) {
        self.until("the lambda to be ready", |line| {
            matches!(line, JsonReport::Lambda(Report::Ready)).then_some(())
        });
    }

    /// Waits until the `init` of each of `count` lambdas has returned; returns their names.
    pub fn until_all_ready(&self, count: usize) -> Vec<String> {
        let mut names = Vec::new();
        self.until_named("all lambdas to be ready", |name, report| {
            names.extend(matches!(report, Report::Ready).then_some(name));
            (names.len() == count).then_some(())
        });
        names
    }

    /// Waits for a status of the lambda for which `wanted` holds.
    pub fn until_live(
        &self,
        what: &str,
        mut wanted: impl FnMut(&LiveStatus) -> bool,
    ) -> LiveStatus {
        self.until(what, |line| match line {
            JsonReport::Lambda(Report::Live(live)) if wanted(&live) => Some(*live),
            _ => None,
        })
    }

    /// Its standard error since the last call.
    pub fn stderr(&self) -> String {
        self.errors.try_iter().collect::<Vec<_>>().join("\n")
    }

    /// Sends it SIGINT, and waits until it ends, as [`finish`](Self::finish).
    pub fn interrupt(self) -> Finished {
        self.signal("INT");
        self.finish()
    }

    /// Waits until it ends by itself; returns the rest of its reports.
    pub fn finish(mut self) -> Finished {
        let deadline = Instant::now() + PATIENCE;
        let mut lines = Vec::new();
        while let Ok(line) =
            self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now()))
        {
            lines.push(line);
        }
        let status = loop {
            match self.child.try_wait().expect("a child can be waited for") {
                Some(status) => break status,
                None if Instant::now() > deadline => {
                    panic!("it does not end; stderr:\n{}", self.stderr())
                }
                None => thread::sleep(Duration::from_millis(10)),
            }
        };
        // What it wrote last may still be on its way from the pipe.
        let mut errors = Vec::new();
        while let Ok(line) = self.errors.recv_timeout(Duration::from_secs(10)) {
            errors.push(line);
        }
        Finished { status, lines, stderr: errors.join("\n") }
    }
}

impl Drop for RunningProgram {
    fn drop(&mut self) {
        if let Ok(None) = self.child.try_wait() {
            // Gracefully; its own children end with it in any case.
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

/// Exit status and remaining output of a program.
pub struct Finished {
    pub status: ExitStatus,
    pub lines: Vec<String>,
    /// Its standard error.
    pub stderr: String,
}

impl Finished {
    /// The final status of the lambda.
    pub fn ended(&self) -> LiveStatus {
        let ended = self.lines.iter().filter_map(|line| parsed(line)).find_map(|line| match line {
            JsonReport::Lambda(Report::Ended(live)) => Some(*live),
            _ => None,
        });
        ended
            .unwrap_or_else(|| panic!("no final report; {}, stderr:\n{}", self.status, self.stderr))
    }

    /// The number of samples that a player has sent of each topic.
    pub fn sent(&self) -> BTreeMap<String, u64> {
        assert!(self.status.success(), "{}", self.stderr);
        let line = self.lines.last().expect("the player prints its summary");
        let summary: serde_json::Value = serde_json::from_str(line).expect("a summary is JSON");
        let topics = summary["topics"].as_array().expect("a summary lists topics").iter();
        let count = |topic: &serde_json::Value| {
            Some((topic["topic"].as_str()?.to_owned(), topic["sent"].as_u64()?))
        };
        topics.map(|topic| count(topic).expect("a topic has a name and a count")).collect()
    }

    /// The final status of the lambda `name`, if there is one.
    pub fn ended_of(&self, name: &str) -> Option<LiveStatus> {
        let reports = self.lines.iter().filter_map(|line| named(line));
        reports.filter(|(lambda, _)| lambda == name).find_map(|(_, report)| match report {
            Report::Ended(live) => Some(*live),
            _ => None,
        })
    }
}

/// Sends a signal to one process.
pub fn signal(pid: u32, name: &str) {
    // It may have just ended.
    let _ = Command::new("kill")
        .arg(format!("-{name}"))
        .arg(pid.to_string())
        .stderr(Stdio::null())
        .status();
}

/// The descendants of process `of` whose command line contains `name`.
pub fn descendants(of: u32, name: &str) -> Vec<u32> {
    // Each thread has the children that it started.
    let threads = std::fs::read_dir(format!("/proc/{of}/task")).into_iter().flatten().flatten();
    let children = threads
        .map(|thread| std::fs::read_to_string(thread.path().join("children")).unwrap_or_default());
    let text = children.collect::<Vec<_>>().join(" ");
    let is_called = |pid: u32| {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        // Python does not have the program's name in its arguments, but `start.py`.
        String::from_utf8_lossy(&line).contains(name)
    };
    let children = text.split_whitespace().filter_map(|pid| pid.parse().ok());
    children
        .flat_map(|pid| is_called(pid).then_some(pid).into_iter().chain(descendants(pid, name)))
        .collect()
}

/// CPU time of a process so far, in ns; 0 if it has ended.
pub fn cpu_ns(pid: u32) -> u64 {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    // The first word is the time on a core. Threads that have ended are not included.
    let times = threads.filter_map(|thread| {
        let text = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<u64>().ok()
    });
    times.sum()
}

/// The decisions in a folder of results.
pub fn decisions(out: &Path) -> Vec<Decision> {
    let text = std::fs::read_to_string(out.join("decisions.jsonl")).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).expect("a line is a decision")).collect()
}

/// The summary in a folder of results.
pub fn summary(out: &Path) -> LiveStatus {
    let text = std::fs::read(out.join("summary.json")).expect("the run has ended");
    serde_json::from_slice(&text).expect("a summary is a status")
}

fn parsed(line: &str) -> Option<JsonReport> {
    let lambda = serde_json::from_str(line).map(JsonReport::Lambda);
    let recorder = |_| serde_json::from_str(line).map(JsonReport::Recorder);
    lambda.or_else(recorder).or_else(|_| serde_json::from_str(line).map(JsonReport::Ingress)).ok()
}

/// A report of a lambda's process, with the name that it is printed with.
fn named(line: &str) -> Option<(String, Report)> {
    let value: serde_json::Value = serde_json::from_str(line).ok()?;
    let lambda = value.get("lambda")?.as_str()?.to_owned();
    Some((lambda, serde_json::from_str(line).ok()?))
}

fn lines_of(stream: impl std::io::Read + Send + 'static) -> Receiver<String> {
    let (sender, receiver) = mpsc::channel();
    thread::spawn(move || {
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    receiver
}
