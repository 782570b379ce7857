//! Compiling a component has a bound of memory and of CPU time, and what would go beyond is refused
//! in words. Native code in the cache runs only as it was written there.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use gleaner_base::Exit;
use gleaner_tests::{Copy, Folder, program, replay, root, sample_drive};

/// A component of so many functions, each of which takes a quarter of a second to be compiled, and
/// not much memory: thousands of values live until its end, and blocks keep the compiler from
/// putting them together.
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

/// `gleaner check` of a lambda that is this component, where compiling has so many seconds.
fn check(component: &[u8], seconds: u64) -> Output {
    let (lambda, home) = (Copy::of("examples/hello/rust", |manifest| manifest), Folder::new());
    lambda.replace("hello.wasm", component);
    let compile = program("gleaner-compile");
    let script =
        format!("#!/bin/sh\nexec '{}' --cpu-seconds {seconds} \"$@\"\n", compile.display());
    let script = home.write("gleaner-compile", script);
    fs::set_permissions(script, PermissionsExt::from_mode(0o755)).unwrap();
    // Without it this would be no installation.
    std::os::unix::fs::symlink(program("gleaner-runtime"), home.path().join("gleaner-runtime"))
        .unwrap();
    let mut check = Command::new(program("gleaner"));
    check.env("GLEANER_HOME", home.path()).env("XDG_CACHE_HOME", home.path().join("cache"));
    check.arg("check").arg(lambda.path()).output().expect("gleaner starts")
}

#[test]
fn a_component_that_is_compiled_for_too_long_is_refused() {
    let output = check(&slow(60), 1);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(i32::from(Exit::Usage.code())), "{said}");
    let expected = [
        "cannot compile component `",
        "hello.wasm`",
        "takes more than 120 s of CPU time to compile",
        "help:",
        "leave out",
    ];
    let mut rest = said.as_ref();
    for words in expected {
        let at = rest.find(words).unwrap_or_else(|| panic!("no `{words}` in:\n{said}"));
        rest = &rest[at + words.len()..];
    }
}

#[test]
fn the_bound_of_cpu_time_can_only_be_made_tighter() {
    let folder = Folder::new();
    let component = folder.write("few.wasm", slow(1));
    for (seconds, ends_well) in
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
            ends_well,
            "{seconds}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
}

#[test]
fn bytes_that_are_no_component_are_refused_once_with_a_help_that_fits() {
    let whole = fs::read(root().join("examples/hello/rust/build/hello.wasm")).unwrap();
    let threads = wat::parse_str("(component (core module (memory 1 1 shared)))").unwrap();
    let cases: [(&[u8], &str, &str); 4] = [
        (
            b"not a component",
            "is no WebAssembly component: its first bytes are not",
            "name the component as `entry`",
        ),
        (
            b"\0asm\x01\0\0\0",
            "is no WebAssembly component: it is a core module",
            "`gleaner build DIR`, which makes",
        ),
        (
            &whole[..whole.len() / 2],
            "cannot compile component",
            "may be cut off or damaged; build the lambda again",
        ),
        (&threads, "threads must be enabled", "without that proposal of WebAssembly"),
    ];
    for (component, cause, help) in cases {
        let copy = Copy::of("examples/hello/rust", |manifest| manifest);
        copy.replace("hello.wasm", component);
        let run = replay(copy.path(), &[sample_drive()], &[]);
        let said = &run.must_exit(Exit::Usage.code()).stderr;
        assert!(said.starts_with("error: cannot load lambda `hello`\n  cause: "), "{said}");
        assert!(said.contains(cause) && said.contains(help), "{said}");
        assert_eq!(
            [said.matches("hello.wasm").count(), said.matches("help:").count()],
            [1, 1],
            "{said}"
        );
    }
}

/// A cache of this test's own, with native code of `hello` in it.
struct Cache {
    home: Folder,
    entry: PathBuf,
    healthy: Vec<u8>,
}

impl Cache {
    fn new() -> Self {
        let home = Folder::new();
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

    /// Replays `hello`, which has to go well, and returns its decisions and what was printed.
    fn replay(&self, out: &str) -> (String, String) {
        let output = self.command(out).output().expect("gleaner-runtime starts");
        self.ended_well(out, &output)
    }

    fn ended_well(&self, out: &str, output: &Output) -> (String, String) {
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(0), "{said}");
        let decisions =
            fs::read_to_string(self.home.path().join(out).join("decisions.jsonl")).unwrap();
        (decisions.lines().map(without_time).collect(), said)
    }

    /// Has other bytes where the code is.
    fn put(&self, bytes: &[u8]) {
        fs::write(&self.entry, bytes).unwrap();
    }

    fn warning(&self) -> String {
        let file = self.entry.display();
        format!(
            "warning: native code in the cache is damaged: the component is compiled again file={file} why="
        )
    }
}

/// A line of `decisions.jsonl` but for times of this machine.
fn without_time(line: &str) -> String {
    let mut decision: serde_json::Map<String, serde_json::Value> =
        serde_json::from_str(line).unwrap();
    decision.remove("run_ns");
    serde_json::Value::Object(decision).to_string() + "\n"
}

#[test]
fn native_code_that_was_changed_is_never_run_and_is_made_again() {
    let cache = Cache::new();
    let (expected, said) = cache.replay("healthy");
    assert_eq!(said, "", "healthy code was not taken");
    assert_eq!(expected.matches("hard-brake").count(), 3);
    let flipped = |at: usize, bits: u8| {
        let mut bytes = cache.healthy.clone();
        bytes[at] ^= bits;
        bytes
    };
    // A number of the lambda's: 3 s, within which it does not trigger again.
    let refractory = 3_000_000_000_u64.to_le_bytes();
    let constant =
        cache.healthy.windows(8).position(|bytes| bytes == refractory).expect("it is in the code");
    let mut damaged = vec![
        flipped(constant + 3, 0x80),
        cache.healthy[..cache.healthy.len() / 2].to_vec(),
        Vec::new(),
        vec![0; cache.healthy.len()],
        fs::read(program("gleaner-compile")).unwrap(),
        // As it was before there were digests.
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
        let (decisions, said) = cache.replay("damaged");
        assert_eq!(decisions, expected, "case {case}");
        assert!(
            said.starts_with(&cache.warning()) && said.lines().count() == 1,
            "case {case}: {said}"
        );
        assert_eq!(
            cache.replay("again"),
            (expected.clone(), String::new()),
            "case {case}: it was not made again"
        );
    }
}

#[test]
fn native_code_of_another_component_is_not_run() {
    let cache = Cache::new();
    let mut compile = Command::new(program("gleaner-compile"));
    let other = root().join("tests/lambdas/misbehave/rust/build/misbehave.wasm");
    let output =
        compile.arg(other).arg("--cache").arg(cache.home.path().join("gleaner")).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (expected, _) = cache.replay("healthy");
    cache.put(&fs::read(String::from_utf8_lossy(&output.stdout).trim_end()).unwrap());
    let (decisions, said) = cache.replay("other");
    assert_eq!(decisions, expected);
    assert!(said.starts_with(&cache.warning()), "{said}");
}

#[test]
fn processes_that_meet_damaged_code_at_the_same_time_all_go_on() {
    let cache = Cache::new();
    let (expected, _) = cache.replay("healthy");
    cache.put(&cache.healthy[..1000]);
    let outs: Vec<_> = (0..8).map(|number| format!("at-once-{number}")).collect();
    let replays: Vec<_> = outs
        .iter()
        .map(|out| cache.command(out).spawn().expect("gleaner-runtime starts"))
        .collect();
    for (out, replay) in outs.iter().zip(replays) {
        let (decisions, _) = cache.ended_well(out, &replay.wait_with_output().unwrap());
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
fn what_is_no_file_in_the_place_of_native_code_is_refused_and_not_waited_for() {
    let cache = Cache::new();
    fs::remove_file(&cache.entry).unwrap();
    let refused = |why: &str| {
        let output = cache.command("refused").output().expect("gleaner-runtime starts");
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(i32::from(Exit::Denied.code())), "{said}");
        assert!(said.contains(why) && said.contains("rm -r"), "{said}");
    };
    assert!(Command::new("mkfifo").arg(&cache.entry).status().unwrap().success());
    refused("it is no file");
    fs::remove_file(&cache.entry).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &cache.entry).unwrap();
    refused("it is a link");
    fs::remove_file(&cache.entry).unwrap();
    fs::create_dir(&cache.entry).unwrap();
    refused("it is no file");
    fs::remove_dir(&cache.entry).unwrap();
    cache.replay("without");
    assert!(cache.entry.is_file());
}

#[test]
fn what_a_killed_process_began_in_the_cache_goes_with_the_next_that_compiles() {
    let (folder, cache) = (Folder::new(), Folder::new());
    let component = folder.write("few.wasm", slow(1));
    let compile = || {
        let mut compile = Command::new(program("gleaner-compile"));
        compile.arg(&component).arg("--cache").arg(cache.path()).stdout(Stdio::null());
        compile
    };
    fs::set_permissions(cache.path(), PermissionsExt::from_mode(0o700)).unwrap();
    let left = cache.write("killed.part", [0; 1000]);
    let theirs = cache.write("theirs.part", [0; 1000]);
    let writer = fs::File::options().write(true).open(&theirs).unwrap();
    writer.lock().unwrap();
    assert!(compile().status().unwrap().success());
    assert!(!left.exists() && theirs.exists(), "{:?}", names(cache.path()));
}
