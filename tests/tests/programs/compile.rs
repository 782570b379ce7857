//! Compiling a component has limits of memory and CPU time; a component that exceeds them is
//! refused with a message. Native code in the cache runs only if it is unchanged.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use gleaner_base::Exit;
use gleaner_tests::{LambdaCopy, TempFolder, program, replay, root, sample_drive};

/// A component of `functions` functions. Each takes a quarter of a second to compile, and little
/// memory: thousands of values live until its end, and blocks prevent the compiler from merging
/// them.
fn slow(functions: usize) -> Vec<u8> {
    const VALUES: usize = 4000;
    let block =
        "block local.get 0 i32.wrap_i64 br_if 0 local.get 1 i64.const 3 i64.mul local.set 1 end ";
    let value = format!("local.get 0 i64.const 7 i64.rotl local.tee 0 {block}");
    let body = value.repeat(VALUES) + &"i64.xor ".repeat(VALUES - 1);
    let function = format!("(func (param i64 i64) (result i64) {body})");
    let text = format!("(component (core module {}))", function.repeat(functions));
    wat::parse_str(text).expect("the test's own component")
}

/// Runs `gleaner check` on a lambda with this component and a limit of CPU time for compiling.
fn check(component: &[u8], seconds: u64) -> Output {
    let (lambda, home) =
        (LambdaCopy::of("examples/hello/rust", |manifest| manifest), TempFolder::new());
    lambda.replace("hello.wasm", component);
    let compile = program("gleaner-compile");
    let script =
        format!("#!/bin/sh\nexec '{}' --cpu-seconds {seconds} \"$@\"\n", compile.display());
    let script = home.write("gleaner-compile", script);
    fs::set_permissions(script, PermissionsExt::from_mode(0o755)).unwrap();
    // The folder must look like an installation.
    std::os::unix::fs::symlink(program("gleaner-runtime"), home.path().join("gleaner-runtime"))
        .unwrap();
    let mut check = Command::new(program("gleaner"));
    check.env("GLEANER_HOME", home.path()).env("XDG_CACHE_HOME", home.path().join("cache"));
    check.arg("check").arg(lambda.path()).output().expect("gleaner starts")
}

#[test]
fn a_component_that_is_compiled_for_too_long_is_refused() {
    let output = check(&slow(60), 1);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(i32::from(Exit::Usage.code())), "{stderr}");
    let expected = [
        "cannot compile component `",
        "hello.wasm`",
        "takes more than 120 s of CPU time",
        "help:",
        "remove code",
    ];
    let mut rest = stderr.as_ref();
    for words in expected {
        let at = rest.find(words).unwrap_or_else(|| panic!("no `{words}` in:\n{stderr}"));
        rest = &rest[at + words.len()..];
    }
}

#[test]
fn the_limit_of_cpu_time_can_only_be_lowered() {
    let folder = TempFolder::new();
    let component = folder.write("few.wasm", slow(1));
    for (seconds, succeeds) in
        [("120", true), ("121", false), ("0", false), ("-1", false), ("x", false)]
    {
        let mut compile = Command::new(program("gleaner-compile"));
        compile
            .arg(&component)
            .arg("--cache")
            .arg(folder.path().join(seconds))
            .args(["--cpu-seconds", seconds]);
        let output = compile.output().expect("gleaner-compile starts");
        assert_eq!(
            output.status.success(),
            succeeds,
            "{seconds}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
}

#[test]
fn invalid_components_are_refused_once_with_specific_help() {
    let whole = fs::read(root().join("examples/hello/rust/build/hello.wasm")).unwrap();
    let threads = wat::parse_str("(component (core module (memory 1 1 shared)))").unwrap();
    let cases: [(&[u8], &str, &str); 4] = [
        (
            b"not a component",
            "is not a WebAssembly component: its first bytes are not",
            "set `entry` in lambda.toml to the component",
        ),
        (
            b"\0asm\x01\0\0\0",
            "is not a WebAssembly component: it is a core module",
            "`gleaner build DIR`, which makes",
        ),
        (
            &whole[..whole.len() / 2],
            "cannot compile component",
            "may be truncated or damaged; build the lambda again",
        ),
        (&threads, "threads must be enabled", "without that WebAssembly proposal"),
    ];
    for (component, cause, help) in cases {
        let copy = LambdaCopy::of("examples/hello/rust", |manifest| manifest);
        copy.replace("hello.wasm", component);
        let run = replay(copy.path(), &[sample_drive()], &[]);
        let stderr = &run.must_exit(Exit::Usage.code()).stderr;
        assert!(stderr.starts_with("error: cannot load lambda `hello`\n  cause: "), "{stderr}");
        assert!(stderr.contains(cause) && stderr.contains(help), "{stderr}");
        assert_eq!(
            [stderr.matches("hello.wasm").count(), stderr.matches("help:").count()],
            [1, 1],
            "{stderr}"
        );
    }
}

/// A cache for one test, with native code of `hello` in it.
struct CodeCache {
    home: TempFolder,
    entry: PathBuf,
    healthy: Vec<u8>,
}

impl CodeCache {
    fn new() -> Self {
        let home = TempFolder::new();
        fs::set_permissions(home.path(), PermissionsExt::from_mode(0o700)).unwrap();
        let mut cache = Self { home, entry: PathBuf::new(), healthy: Vec::new() };
        cache.replay("first");
        cache.entry = fs::read_dir(cache.home.path().join("gleaner"))
            .unwrap()
            .next()
            .unwrap()
            .unwrap()
            .path();
        cache.healthy = fs::read(&cache.entry).unwrap();
        cache
    }

    fn command(&self, out: &str) -> Command {
        let mut replay = Command::new(program("gleaner-runtime"));
        replay
            .env("XDG_CACHE_HOME", self.home.path())
            .arg("replay")
            .arg(root().join("examples/hello/rust"));
        replay.arg(sample_drive()).args(["--set", "brake_mps2=-1.4", "--no-record", "--out"]);
        replay.arg(self.home.path().join(out)).stdout(Stdio::null()).stderr(Stdio::piped());
        replay
    }

    /// Replays `hello`, which must succeed; returns its decisions and its standard error.
    fn replay(&self, out: &str) -> (String, String) {
        let output = self.command(out).output().expect("gleaner-runtime starts");
        self.must_succeed(out, &output)
    }

    fn must_succeed(&self, out: &str, output: &Output) -> (String, String) {
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(0), "{stderr}");
        let decisions =
            fs::read_to_string(self.home.path().join(out).join("decisions.jsonl")).unwrap();
        (decisions.lines().map(without_time).collect(), stderr)
    }

    /// Replaces the native code by other bytes.
    fn put(&self, bytes: &[u8]) {
        fs::write(&self.entry, bytes).unwrap();
    }

    fn warning(&self) -> String {
        let file = self.entry.display();
        format!(
            "warning: native code in the cache is damaged; compiling the component again \
             file={file} why="
        )
    }
}

/// A line of `decisions.jsonl` without durations.
fn without_time(line: &str) -> String {
    let mut decision: serde_json::Map<String, serde_json::Value> =
        serde_json::from_str(line).unwrap();
    decision.remove("run_ns");
    serde_json::Value::Object(decision).to_string() + "\n"
}

#[test]
fn changed_native_code_is_never_run_and_is_compiled_again() {
    let cache = CodeCache::new();
    let (expected, stderr) = cache.replay("healthy");
    assert_eq!(stderr, "", "healthy code was not used");
    assert_eq!(expected.matches("hard-brake").count(), 3);
    let flipped = |at: usize, bits: u8| {
        let mut bytes = cache.healthy.clone();
        bytes[at] ^= bits;
        bytes
    };
    // A constant of the lambda: 3 s, within which it does not trigger again.
    let refractory = 3_000_000_000_u64.to_le_bytes();
    let constant = cache
        .healthy
        .windows(8)
        .position(|bytes| bytes == refractory)
        .expect("the constant is in the code");
    let mut damaged = vec![
        flipped(constant + 3, 0x80),
        cache.healthy[..cache.healthy.len() / 2].to_vec(),
        Vec::new(),
        vec![0; cache.healthy.len()],
        fs::read(program("gleaner-compile")).unwrap(),
        // The format before there were digests.
        cache.healthy[48..].to_vec(),
    ];
    let mut state = 1_u64;
    damaged.extend((0..6).map(|bit| {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        flipped((state >> 33) as usize % cache.healthy.len(), 1 << bit)
    }));
    for (case, bytes) in damaged.iter().enumerate() {
        cache.put(bytes);
        let (decisions, stderr) = cache.replay("damaged");
        assert_eq!(decisions, expected, "case {case}");
        assert!(
            stderr.starts_with(&cache.warning()) && stderr.lines().count() == 1,
            "case {case}: {stderr}"
        );
        assert_eq!(
            cache.replay("again"),
            (expected.clone(), String::new()),
            "case {case}: it was not compiled again"
        );
    }
}

#[test]
fn native_code_of_another_component_is_not_run() {
    let cache = CodeCache::new();
    let mut compile = Command::new(program("gleaner-compile"));
    let other = root().join("tests/lambdas/misbehave/rust/build/misbehave.wasm");
    let output =
        compile.arg(other).arg("--cache").arg(cache.home.path().join("gleaner")).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (expected, _) = cache.replay("healthy");
    cache.put(&fs::read(String::from_utf8_lossy(&output.stdout).trim_end()).unwrap());
    let (decisions, stderr) = cache.replay("other");
    assert_eq!(decisions, expected);
    assert!(stderr.starts_with(&cache.warning()), "{stderr}");
}

#[test]
fn processes_that_find_damaged_code_at_the_same_time_all_succeed() {
    let cache = CodeCache::new();
    let (expected, _) = cache.replay("healthy");
    cache.put(&cache.healthy[..1000]);
    let outs: Vec<_> = (0..8).map(|number| format!("concurrent-{number}")).collect();
    let replays: Vec<_> = outs
        .iter()
        .map(|out| cache.command(out).spawn().expect("gleaner-runtime starts"))
        .collect();
    for (out, replay) in outs.iter().zip(replays) {
        let (decisions, _) = cache.must_succeed(out, &replay.wait_with_output().unwrap());
        assert_eq!(decisions, expected, "{out}");
    }
    assert_eq!(
        names(cache.entry.parent().unwrap()),
        [cache.entry.file_name().unwrap().to_str().unwrap()]
    );
    assert_eq!(cache.replay("after"), (expected, String::new()));
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

#[test]
fn a_pipe_link_or_folder_in_place_of_native_code_is_refused() {
    let cache = CodeCache::new();
    fs::remove_file(&cache.entry).unwrap();
    let refused = |why: &str| {
        let output = cache.command("refused").output().expect("gleaner-runtime starts");
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(i32::from(Exit::Denied.code())), "{stderr}");
        assert!(stderr.contains(why) && stderr.contains("rm -r"), "{stderr}");
    };
    assert!(Command::new("mkfifo").arg(&cache.entry).status().unwrap().success());
    refused("it is not a regular file");
    fs::remove_file(&cache.entry).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &cache.entry).unwrap();
    refused("it is a link");
    fs::remove_file(&cache.entry).unwrap();
    fs::create_dir(&cache.entry).unwrap();
    refused("it is not a regular file");
    fs::remove_dir(&cache.entry).unwrap();
    cache.replay("without");
    assert!(cache.entry.is_file());
}

#[test]
fn partial_files_of_killed_processes_are_deleted_by_the_next_that_compiles() {
    let (folder, cache) = (TempFolder::new(), TempFolder::new());
    let component = folder.write("few.wasm", slow(1));
    let compile = || {
        let mut compile = Command::new(program("gleaner-compile"));
        compile.arg(&component).arg("--cache").arg(cache.path()).stdout(Stdio::null());
        compile
    };
    fs::set_permissions(cache.path(), PermissionsExt::from_mode(0o700)).unwrap();
    let orphan = cache.write("killed.part", [0; 1000]);
    let in_use = cache.write("in-use.part", [0; 1000]);
    let writer = fs::File::options().write(true).open(&in_use).unwrap();
    writer.lock().unwrap();
    assert!(compile().status().unwrap().success());
    assert!(!orphan.exists() && in_use.exists(), "{:?}", names(cache.path()));
}
