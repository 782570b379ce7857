//! Shared by the suites: paths of the checkout, replays, and drives made for tests.

pub mod architecture;
pub mod bag;
pub mod budgets;
pub mod cloud;
pub mod denied;
pub mod drive;
pub mod fake_messages;
pub mod live;
pub mod markdown;
pub mod namespace;
pub mod parts;
pub mod peers;
pub mod readers;
pub mod transcript;
pub mod tree;
pub mod vehicle;
pub mod words;

use std::ffi::OsStr;
use std::io::ErrorKind;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

use gleaner_lambda::manifest::Manifest;
use gleaner_lambda::{Clip, Decision};
use gleaner_protocol::{ReplaySummary, Report, Verified};
use gleaner_report::format::{seconds, trigger_lines};
pub use gleaner_test_support::shared_file;

/// The checkout; of `gleaner-bench` in an unpacked tarball, the folder of the tarball, where all
/// that it reads has the same place.
pub fn root() -> PathBuf {
    let checkout = Path::new(env!("CARGO_MANIFEST_DIR")).parent();
    unpacked().unwrap_or_else(|| checkout.expect("tests/ lies in the checkout").to_owned())
}

/// The folder of the unpacked tarball that this program belongs to, if it does.
fn unpacked() -> Option<PathBuf> {
    let exe = std::env::current_exe().ok()?;
    let root = exe.parent().filter(|folder| folder.ends_with("bin"))?.parent()?;
    root.join("lib/gleaner").is_dir().then(|| root.to_owned())
}

/// The folder with `start.py` and the Python package `gleaner`.
pub fn python_home() -> PathBuf {
    match unpacked() {
        Some(root) => root.join("lib/gleaner"),
        None => root().join("guest-sdk-python"),
    }
}

/// The recorded drive that comes with the project.
pub fn sample_drive() -> PathBuf {
    root().join("examples/data/highway_drive.mcap")
}

/// A program of the workspace: built into the same folder as this one, or of the same tarball.
pub fn program(name: &str) -> PathBuf {
    find_program(name).unwrap_or_else(|| panic!("{name} is not built; run: cargo xtask test"))
}

/// As [`program`]; `None` if it is not built.
pub fn find_program(name: &str) -> Option<PathBuf> {
    if let Some(root) = unpacked() {
        let places = ["bin", "lib/gleaner"].map(|folder| root.join(folder).join(name));
        return places.into_iter().find(|path| path.is_file());
    }
    let test = std::env::current_exe().expect("a test has a path");
    // target/release/deps/test-0123, or target/release/bench
    let folder = test.parent().expect("a program lies in a folder");
    let folder = if folder.ends_with("deps") { folder.parent().unwrap_or(folder) } else { folder };
    Some(folder.join(name)).filter(|path| path.is_file())
}

/// Number of repetitions of a test: the variable `name`, else `usual`, which is short, or twenty
/// times that with `GLEANER_LONG=1`. CONTRIBUTING.md ("Tests") lists the variables.
pub fn times(name: &str, usual: u32) -> u32 {
    let is_long = std::env::var_os("GLEANER_LONG").is_some_and(|value| value == "1");
    let Some(value) = std::env::var_os(name) else {
        return if is_long { 20 * usual } else { usual };
    };
    let times = value.to_str().and_then(|text| text.parse().ok()).filter(|times| *times > 0);
    times.unwrap_or_else(|| {
        panic!("{name} is {value:?}; set it to a whole number above 0, or not at all")
    })
}

/// A temporary folder, deleted on drop.
pub struct TempFolder(PathBuf);

impl TempFolder {
    /// A new empty folder.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        loop {
            let number = COUNT.fetch_add(1, Ordering::Relaxed);
            let name = format!("gleaner-test-{}-{number}", std::process::id());
            let path = std::env::temp_dir().join(name);
            // One that exists may belong to another user.
            match std::fs::DirBuilder::new().mode(0o700).create(&path) {
                Ok(()) => return Self(path),
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
                Err(error) => panic!("{}: {error}", path.display()),
            }
        }
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Writes a file into it.
    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.join(name);
        std::fs::create_dir_all(path.parent().expect("a file has a folder"))
            .expect("the folder is writable");
        std::fs::write(&path, content).expect("the folder is writable");
        path
    }
}

impl Drop for TempFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

pub struct ReplayRun {
    /// Exit code; 128 and more for a signal.
    pub exit: i32,
    /// Its standard error.
    pub stderr: String,
    pub decisions: Vec<Decision>,
    pub log: Vec<serde_json::Value>,
    pub clips: Vec<Clip>,
    /// The final report; `None` if there was none.
    pub summary: Option<ReplaySummary>,
}

/// `gleaner-runtime` with the tests' own cache of compiled code: the user's cache is neither used
/// nor changed.
pub fn runtime() -> Command {
    let mut runtime = Command::new(program("gleaner-runtime"));
    runtime.env("XDG_CACHE_HOME", root().join("target/test-cache"));
    runtime
}

/// `gleaner`, with the same cache.
pub fn gleaner() -> Command {
    let mut gleaner = Command::new(program("gleaner"));
    gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache"));
    gleaner
}

/// Replays the built lambda in `lambda` over `drives`; with `gleaner` if it has models, which
/// starts the process that runs them.
pub fn replay(lambda: &Path, drives: &[PathBuf], args: &[&str]) -> ReplayRun {
    replay_to(TempFolder::new().path(), lambda, drives, args)
}

/// As [`replay`], with results in `out`.
pub fn replay_to(out: &Path, lambda: &Path, drives: &[PathBuf], args: &[&str]) -> ReplayRun {
    let manifest = Manifest::load(lambda.join("build"));
    let has_models = manifest.is_ok_and(|manifest| !manifest.models.is_empty());
    let mut replay = if has_models { gleaner() } else { runtime() };
    replay.arg("replay").arg(lambda).args(drives).args(args).arg("--out").arg(out);
    if has_models {
        replay.args(["--json", "--no-report"]);
    }
    let output = replay.output().expect("the program starts");
    let read = |name: &str| std::fs::read_to_string(out.join(name)).unwrap_or_default();
    ReplayRun {
        exit: output.status.code().unwrap_or(128),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        decisions: read("decisions.jsonl").lines().map(parsed).collect(),
        log: read("log.jsonl").lines().map(parsed).collect(),
        clips: read("clips.jsonl").lines().map(parsed).collect(),
        summary: if has_models {
            serde_json::from_slice(&output.stdout).ok()
        } else {
            reports(&output.stdout).find_map(|report| match report {
                Report::Summary(summary) => Some(*summary),
                _ => None,
            })
        },
    }
}

/// Result of a comparison.
pub struct Verification {
    /// Exit code; 128 and more for a signal.
    pub exit: i32,
    /// Its standard error: the first difference, both sides.
    pub stderr: String,
    /// The result; `None` if there is a difference.
    pub verified: Option<Verified>,
}

/// Runs `gleaner-runtime` with `args`, which request a comparison.
pub fn verify(args: &[&OsStr]) -> Verification {
    let output = runtime().args(args).output().expect("gleaner-runtime starts");
    Verification {
        exit: output.status.code().unwrap_or(128),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        verified: reports(&output.stdout).find_map(|report| match report {
            Report::Verified(verified) => Some(verified),
            _ => None,
        }),
    }
}

pub fn verify_clip(clip: &Path, lambda: &Path) -> Verification {
    verify(&["verify".as_ref(), clip.as_ref(), "--lambda".as_ref(), lambda.as_ref()])
}

fn reports(stdout: &[u8]) -> impl Iterator<Item = Report> {
    String::from_utf8_lossy(stdout).lines().map(parsed).collect::<Vec<_>>().into_iter()
}

fn parsed<T: serde::de::DeserializeOwned>(line: &str) -> T {
    serde_json::from_str(line).unwrap_or_else(|error| panic!("{error} in {line}"))
}

impl ReplayRun {
    /// A line for each trigger, as in `expected.txt`.
    pub fn rows(&self) -> String {
        let lines =
            self.decisions.iter().flat_map(|decision| trigger_lines(decision, self.start_ns()));
        lines.map(|line| line + "\n").collect()
    }

    /// Time of each trigger in seconds from the start of the drive.
    pub fn seconds(&self) -> Vec<f64> {
        let causing = self
            .decisions
            .iter()
            .flat_map(|decision| decision.triggers.iter().map(|_| decision.at_ns));
        causing.map(|at_ns| seconds(at_ns, self.start_ns())).collect()
    }

    pub fn labels(&self) -> Vec<String> {
        let triggers = self.decisions.iter().flat_map(|decision| &decision.triggers);
        triggers.map(|trigger| trigger.label.clone()).collect()
    }

    fn start_ns(&self) -> i64 {
        self.summary.as_ref().map_or(0, |summary| summary.start_ns)
    }

    /// The first fault's kind and message.
    pub fn first_fault(&self) -> Option<(gleaner_lambda::FaultKind, String)> {
        let fault = self.decisions.iter().find_map(|decision| decision.fault.as_ref())?;
        Some((fault.kind, fault.message.clone()))
    }

    /// Asserts the exit code; shows standard error if it differs.
    pub fn must_exit(&self, code: u8) -> &Self {
        assert_eq!(self.exit, i32::from(code), "{}", self.stderr);
        self
    }
}

/// A copy of a built lambda, with a changed manifest.
pub struct LambdaCopy {
    folder: TempFolder,
}

impl LambdaCopy {
    /// Copies the lambda in `lambda`, a folder of the checkout, with `change` applied to its
    /// manifest.
    pub fn of(lambda: &str, change: impl Fn(String) -> String) -> Self {
        let folder = TempFolder::new();
        copy_lambda(lambda, &folder, ".", change);
        Self { folder }
    }

    /// Copies the lambda in `lambda` as one called `name`; if it states a deadline, with one that a
    /// busy machine meets.
    pub fn named(lambda: &str, name: &str) -> Self {
        Self::changed_and_named(lambda, name, |manifest| manifest)
    }

    /// As [`named`](Self::named), with `change` applied to its manifest.
    pub fn changed_and_named(lambda: &str, name: &str, change: impl Fn(String) -> String) -> Self {
        Self::of(lambda, |manifest| {
            let mut table = "";
            let mut changed = String::new();
            for line in manifest.lines() {
                table = if line.starts_with('[') { line } else { table };
                changed += &match (table, line.split_once(" = ")) {
                    ("[lambda]", Some(("name", _))) => format!("name = \"{name}\""),
                    ("[limits]", Some(("deadline", _))) => "deadline = \"5s\"".to_owned(),
                    _ => line.to_owned(),
                };
                changed.push('\n');
            }
            change(changed)
        })
    }

    /// The lambda's folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Replaces a file of the build.
    pub fn replace(&self, name: &str, content: impl AsRef<[u8]>) {
        self.folder.write(&format!("build/{name}"), content);
    }
}

/// Copies all files below `source`, except a manifest, to `name` in `folder`.
fn copy_files(source: &Path, folder: &TempFolder, name: &str) {
    let files = std::fs::read_dir(source)
        .unwrap_or_else(|error| panic!("{}: {error}; run: cargo xtask test", source.display()));
    for file in files {
        let file = file.expect("the folder can be read");
        let to = format!("{name}/{}", file.file_name().to_string_lossy());
        if file.path().is_dir() {
            copy_files(&file.path(), folder, &to);
        } else if file.file_name() != "lambda.toml" {
            folder.write(&to, std::fs::read(file.path()).expect("a build can be read"));
        }
    }
}

/// Copies the built lambda in `lambda`, a folder of the checkout, to `name` in `folder`, with
/// `change` applied to its manifest.
pub fn copy_lambda(
    lambda: &str,
    folder: &TempFolder,
    name: &str,
    change: impl Fn(String) -> String,
) {
    let source = root().join(lambda).join("build");
    copy_files(&source, folder, &format!("{name}/build"));
    let manifest =
        std::fs::read_to_string(source.join("lambda.toml")).expect("a build has a manifest");
    // The build's manifest is written last, because it must not be older than any source.
    folder.write(&format!("{name}/lambda.toml"), change(manifest.clone()));
    folder.write(&format!("{name}/build/lambda.toml"), change(manifest));
}
