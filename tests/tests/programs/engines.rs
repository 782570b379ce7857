//! `gleaner check --build-engines`: engines for TensorRT that are built ahead, by a process with a
//! fake GPU, and by the real one, which finds none.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};

use gleaner_artifacts::BuiltEngine;
use gleaner_tests::live::signal;
use gleaner_tests::{LambdaCopy, TempFolder, program, root};
use serde_json::Value;

/// Exit code of a command that the machine cannot do.
const INTERNAL: i32 = 1;

const MODEL: &str = "models/yolox_nano.onnx";

/// An installation with a fake GPU, a store of its own, and a lambda with a model for TensorRT.
struct Orin {
    home: TempFolder,
    lambda: LambdaCopy,
}

impl Orin {
    fn new() -> Self {
        let home = TempFolder::new();
        fs::set_permissions(home.path(), PermissionsExt::from_mode(0o700)).unwrap();
        for (name, target) in [
            ("gleaner-runtime", program("gleaner-runtime")),
            ("gleaner-inference", program("examples/fake_gpu")),
        ] {
            symlink(target, home.path().join(name)).unwrap();
        }
        fs::create_dir(home.path().join("tmp")).unwrap();
        Self { home, lambda: lambda("[\"tensorrt\"]") }
    }

    /// Returns `gleaner check` of the lambda on this GPU.
    fn command(&self, gpu: &str, args: &[&str]) -> Command {
        let mut check = Command::new(program("gleaner"));
        check.env("GLEANER_HOME", self.home.path()).env("GLEANER_FAKE_GPU", gpu);
        check.env("XDG_CACHE_HOME", self.home.path().join("cache"));
        check.env("TMPDIR", self.home.path().join("tmp"));
        check.arg("check").arg(self.lambda.path()).args(args);
        check.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        check
    }

    fn build(&self, gpu: &str) -> Output {
        self.command(gpu, &["--build-engines"]).output().expect("gleaner starts")
    }

    fn must_build(&self, gpu: &str) -> String {
        let output = self.build(gpu);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    }

    /// Checks the lambda, which must succeed; returns standard error, which names the choice of
    /// each model.
    fn check(&self, gpu: &str) -> String {
        let output = self.command(gpu, &[]).output().expect("gleaner starts");
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{stderr}");
        stderr
    }

    fn engines(&self) -> Vec<PathBuf> {
        let entries = fs::read_dir(self.home.path().join("cache/gleaner")).into_iter().flatten();
        let paths = entries.map(|entry| entry.unwrap().path());
        paths.filter(|path| path.extension().is_some_and(|it| it == "engine")).collect()
    }

    /// Asserts that a build that failed has left nothing.
    #[track_caller]
    fn has_nothing(&self) {
        assert_eq!(self.engines(), Vec::<PathBuf>::new());
        assert_eq!(fs::read_dir(self.home.path().join("tmp")).unwrap().count(), 0);
    }
}

fn lambda(providers: &str) -> LambdaCopy {
    let listed = format!("providers = {providers}\nlayout =");
    LambdaCopy::changed_and_named("examples/yolo-detector/rust", "yolo-detector", |manifest| {
        manifest.replace("layout =", &listed)
    })
}

#[test]
fn an_engine_that_was_built_ahead_is_used_on_its_own_runtime_only() {
    let orin = Orin::new();
    let how = "gleaner check DIR --build-engines";
    let stderr = orin.check("Orin");
    assert!(stderr.contains(&format!("no engine was built ahead: {how}")), "{stderr}");
    let output = orin.build("Orin");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    assert_eq!(stderr, format!("model `{MODEL}`: building its engine, which takes minutes\n"));
    let stdout = String::from_utf8_lossy(&output.stdout);
    assert!(stdout.starts_with(&format!("model `{MODEL}`: engine of 0.0 MiB built in ")));
    assert!(stdout.ends_with(" s for Orin\n"), "{stdout}");
    let stderr = orin.check("Orin");
    assert!(stderr.contains("fake 1, tensorrt, 1 thread, loaded in"), "{stderr}");
    assert!(stderr.contains("; its engine was built ahead)"), "{stderr}");

    // A new driver, for example.
    let stderr = orin.check("Orin 2");
    let other = "its engine was built for another runtime (Orin) than this (Orin 2): ";
    assert!(stderr.contains(&format!("{other}{how}")), "{stderr}");
    let stderr = orin.check("Orin,refuses");
    assert!(stderr.contains("its engine cannot be used: it is of another version"), "{stderr}");
    assert!(stderr.contains("fake 1, tensorrt"), "it was not built again: {stderr}");
    orin.must_build("Orin 2");
    assert_eq!(orin.engines().len(), 1, "the new one replaces the old one");
    assert!(orin.check("Orin 2").contains("its engine was built ahead"));
}

#[test]
fn a_damaged_engine_and_one_that_others_could_have_written_are_not_used() {
    let orin = Orin::new();
    orin.must_build("Orin");
    let entry = orin.engines().remove(0);
    let healthy = fs::read(&entry).unwrap();
    let mut flipped = healthy.clone();
    flipped[healthy.len() - 1] ^= 1;
    let other = entry_of_another_model();
    for damaged in [&flipped[..], &healthy[..healthy.len() - 1], b"", &other] {
        fs::write(&entry, damaged).unwrap();
        let stderr = orin.check("Orin");
        assert!(stderr.contains("its engine is not used: it is damaged: "), "{stderr}");
        assert!(stderr.contains("fake 1, tensorrt"), "{stderr}");
    }
    fs::write(&entry, &healthy).unwrap();
    fs::set_permissions(&entry, PermissionsExt::from_mode(0o666)).unwrap();
    let stderr = orin.check("Orin");
    assert!(stderr.contains("its engine is not used: an engine of TensorRT in "), "{stderr}");
    assert!(stderr.contains("others may write to it"), "{stderr}");
    fs::remove_file(&entry).unwrap();
    symlink("/etc/passwd", &entry).unwrap();
    assert!(orin.check("Orin").contains("it is a link"));
    fs::remove_file(&entry).unwrap();
    orin.must_build("Orin");
    assert_eq!(fs::read(&entry).unwrap(), healthy);
    assert!(orin.check("Orin").contains("its engine was built ahead"));
}

fn entry_of_another_model() -> Vec<u8> {
    let folder = TempFolder::new();
    BuiltEngine::put(folder.path(), &"0".repeat(64), "Orin", b"engine of the fake GPU").unwrap();
    let entry = fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap();
    fs::read(entry.path()).unwrap()
}

#[test]
fn a_build_that_fails_names_the_cause_and_leaves_nothing() {
    let orin = Orin::new();
    for (failure, cause) in [
        ("huge", "it has 537919488 bytes; at most 512 MiB are read"),
        ("link", "outside of `"),
        ("nothing", "it wrote no engine: TensorRT does not run the whole model"),
        ("dies", "gleaner-inference ended unexpectedly (signal: 6"),
    ] {
        let output = orin.build(&format!("Orin,{failure}"));
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(INTERNAL), "{stderr}");
        assert!(stderr.contains("error: cannot build the engine of model `detector`"), "{stderr}");
        assert!(stderr.contains(cause) && stderr.contains("help:"), "{cause}: {stderr}");
        orin.has_nothing();
    }
}

/// Starts a build that never ends, and waits until it shows its progress.
/// Also returns its standard error.
fn endless(orin: &Orin) -> (Child, impl Read) {
    let mut child = orin.command("Orin,hangs", &["--build-engines"]).spawn().unwrap();
    let mut stderr = BufReader::new(child.stderr.take().unwrap());
    let lines = stderr.by_ref().lines().map_while(Result::ok);
    let progress = format!("model `{MODEL}`: still building, ");
    assert!({ lines }.any(|line| line.starts_with(&progress)));
    (child, stderr)
}

#[test]
fn an_interrupted_build_leaves_nothing_and_a_killed_one_no_engine() {
    let orin = Orin::new();
    let (mut child, mut stderr) = endless(&orin);
    signal(child.id(), "INT");
    let mut text = String::new();
    stderr.read_to_string(&mut text).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(INTERNAL), "{text}");
    assert!(text.contains("cause: it was interrupted"), "{text}");
    orin.has_nothing();
    let (mut child, _stderr) = endless(&orin);
    child.kill().unwrap();
    child.wait().unwrap();
    assert_eq!(orin.engines(), Vec::<PathBuf>::new());
    orin.must_build("Orin");
    assert!(orin.check("Orin").contains("its engine was built ahead"));
}

#[test]
fn two_builds_at_once_leave_one_whole_engine() {
    let orin = Orin::new();
    let builds = ["Orin", "Orin"].map(|gpu| orin.command(gpu, &["--build-engines", "--json"]));
    let builds = builds.map(|mut build| build.spawn().expect("gleaner starts"));
    for build in builds {
        let output = build.wait_with_output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{stderr}");
        let results: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(results[0]["model"], MODEL);
        assert_eq!(results[0]["engine"]["runtime"], "Orin");
        assert_eq!(results[0]["engine"]["bytes"], 22);
    }
    assert_eq!(orin.engines().len(), 1);
    assert!(orin.check("Orin").contains("its engine was built ahead"));
}

#[test]
fn without_a_gpu_a_build_is_refused_and_without_tensorrt_there_is_nothing_to_build() {
    let build = |lambda: &LambdaCopy, args: &[&str]| {
        let mut check = Command::new(program("gleaner"));
        check.env("XDG_CACHE_HOME", root().join("target/test-cache"));
        check.arg("check").arg(lambda.path()).arg("--build-engines").args(args);
        let output = check.output().expect("gleaner starts");
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (output.status.code(), text(output.stdout), text(output.stderr))
    };
    let (exit, stdout, stderr) = build(&lambda("[\"tensorrt\", \"cpu\"]"), &[]);
    assert_eq!((exit, &*stdout), (Some(INTERNAL), ""), "{stderr}");
    assert!(stderr.contains("`tensorrt` failed: "), "{stderr}");
    let cpu = lambda("[\"cpu\"]");
    let (exit, stdout, stderr) = build(&cpu, &[]);
    let expected = "nothing to build: its `providers` do not name `tensorrt`";
    assert_eq!((exit, stdout), (Some(0), format!("model `{MODEL}`: {expected}\n")), "{stderr}");
    let (exit, stdout, _) = build(&cpu, &["--json"]);
    let results: Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!((exit, &results[0]["engine"]), (Some(0), &Value::Null));
}
