//! The plain Python program for comparison, `bench/baselines/detector.py`.

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use gleaner_tests::root;
use serde_json::Value;

use super::frames::{HEIGHT, WIDTH};
use super::model_process::BenchModel;
use super::{MAX_COUNT, MAX_IOU, MIN_SCORE, THREADS};
use gleaner_bench::python;

/// The started program.
pub(super) struct PythonProgram {
    child: Child,
    requests: Option<ChildStdin>,
    replies: Lines<BufReader<ChildStdout>>,
    /// Versions of its libraries.
    pub(super) runtime: String,
}

/// Its result for a frame.
pub(super) struct PythonResult {
    pub(super) total_ms: f64,
    pub(super) prepare_ms: f64,
    pub(super) session_ms: f64,
    pub(super) boxes: f64,
}

impl PythonProgram {
    /// Starts it; returns the reason if it lacks a library.
    pub(super) fn start(model: &BenchModel, frames: &Path) -> Result<Self, String> {
        let python = std::env::var_os("GLEANER_BENCH_PYTHON").map_or_else(python, PathBuf::from);
        let numbers = [
            WIDTH.to_string(),
            HEIGHT.to_string(),
            THREADS.to_string(),
            MIN_SCORE.to_string(),
            MAX_IOU.to_string(),
            MAX_COUNT.to_string(),
        ];
        let mut child = Command::new(&python)
            .arg(root().join("bench/baselines/detector.py"))
            .env("ORT_DISABLE_TELEMETRY", "1")
            .args([&model.path, frames])
            .arg(model.layout.name())
            .args(numbers)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| format!("cannot start `{}`: {error}", python.display()))?;
        let requests = child.stdin.take();
        let replies = BufReader::new(child.stdout.take().expect("a pipe")).lines();
        let mut started = Self { child, requests, replies, runtime: String::new() };
        let first = started.reply();
        match (first["runtime"].as_str(), first["missing"].as_str()) {
            (Some(runtime), _) => started.runtime = runtime.to_owned(),
            (None, missing) => return Err(missing.unwrap_or("it failed").to_owned()),
        }
        Ok(started)
    }

    /// Finds objects in a frame of the file.
    pub(super) fn detect(&mut self, number: usize) -> PythonResult {
        let requests = self.requests.as_mut().expect("it is open until the end");
        writeln!(requests, "{number}").expect("it reads");
        let reply = self.reply();
        let number = |key: &str| reply[key].as_f64().unwrap_or(f64::NAN);
        PythonResult {
            total_ms: number("total_ms"),
            prepare_ms: number("prepare_ms"),
            session_ms: number("session_ms"),
            boxes: number("boxes"),
        }
    }

    pub(super) fn id(&self) -> u32 {
        self.child.id()
    }

    fn reply(&mut self) -> Value {
        let line = self.replies.next().and_then(Result::ok);
        line.and_then(|line| serde_json::from_str(&line).ok()).unwrap_or(Value::Null)
    }
}

impl Drop for PythonProgram {
    fn drop(&mut self) {
        // Its input ends, and with it the program.
        self.requests = None;
        let _ = self.child.wait();
    }
}
