//! Start-up code of a Python lambda's own environment, which runs before the lambda and is
//! untrusted, is sandboxed like the lambda.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::programs::InstalledPrograms;
use gleaner_tests::{TempFolder, copy_lambda, program, root, runtime, sample_drive};

/// Actions that `sitecustomize.py` attempts; it prints the name of each and the outcome.
const TRIES: &str = r#"
import fcntl, os, resource, socket, sys

TRIES = {
    "read": lambda: open("/etc/passwd").read(),
    "write": lambda: open(__file__ + ".more", "w").write("x"),
    "fork": lambda: os.fork() or os._exit(0),
    "program": lambda: os.posix_spawn("/bin/true", ["true"], {}),
    "other_program": lambda: os.execv(sys.executable, [sys.executable, "-c", ""]),
    "signal": lambda: os.kill(os.getppid(), 0),
    "neighbours": lambda: socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM),
    "datagrams": lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM),
    "streams": lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM, 262),
    "cores": lambda: os.sched_setaffinity(0, os.sched_getaffinity(0)),
    "dates": lambda: os.utime(__file__),
    "lease": lambda: fcntl.fcntl(os.open(__file__, os.O_RDONLY), 1024, fcntl.F_RDLCK),
    "stack": lambda: resource.setrlimit(resource.RLIMIT_STACK, (1 << 30, 1 << 30)),
    "memory": lambda: os.memfd_create("more"),
    "other_memory": lambda: open(f"/proc/{os.getppid()}/mem", "rb"),
    "room": lambda: len(bytearray(16 << 30)),
}
for name, attempt in TRIES.items():
    try:
        print(f"<{name}> went: {attempt()!r}"[:200], file=sys.stderr)
    except (OSError, MemoryError, ValueError):
        print(f"<{name}> refused", file=sys.stderr)
"#;

/// A lambda with an environment that runs [`TRIES`] when its interpreter starts. It has no numpy,
/// so the start fails afterwards.
fn hostile(folder: &TempFolder) -> PathBuf {
    copy_lambda("tests/lambdas/misbehave/python", folder, "lambda", |manifest| manifest);
    let lambda = folder.path().join("lambda");
    let python = InstalledPrograms::find()
        .and_then(|parts| parts.python(None))
        .expect("Python is installed");
    let made = Command::new(python)
        .args(["-m", "venv", "--without-pip", ".venv"])
        .current_dir(&lambda)
        .status();
    assert!(made.expect("Python starts").success());
    let lib = lambda.join(".venv/lib");
    let version =
        std::fs::read_dir(&lib).unwrap().next().expect("a folder for the version").unwrap().path();
    std::fs::write(version.join("site-packages/sitecustomize.py"), TRIES).unwrap();
    lambda
}

fn start(lambda: &Path, out: &Path, with_shim: bool) -> String {
    let mut command = if with_shim {
        let mut shim = Command::new(program("gleaner-shim"));
        shim.arg("--")
            .arg(program("gleaner-runtime"))
            .env("XDG_CACHE_HOME", root().join("target/test-cache"));
        shim
    } else {
        runtime()
    };
    // The variable would replace the lambda's own environment.
    command
        .env_remove("GLEANER_PYTHON")
        .arg("replay")
        .arg(lambda)
        .arg(sample_drive())
        .arg("--out")
        .arg(out);
    let output = command.output().expect("the program starts");
    assert_ne!(output.status.code(), Some(0), "an environment without numpy is not usable");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn start_up_code_of_an_environment_runs_in_the_sandbox() {
    let folder = TempFolder::new();
    let lambda = hostile(&folder);
    let tries = TRIES
        .lines()
        .filter_map(|line| line.strip_prefix("    \"")?.split_once('"'))
        .map(|(name, _)| name);
    let tries: Vec<_> = tries.collect();
    assert_eq!(tries.len(), 16);
    for with_shim in [true, false] {
        let stderr = start(&lambda, &folder.path().join("out"), with_shim);
        for name in &tries {
            assert!(stderr.contains(&format!("<{name}> refused")), "{name}: {stderr}");
        }
        assert!(
            stderr.contains("at the start of its environment: No module named 'numpy'; "),
            "{stderr}"
        );
        assert!(
            stderr.contains("pip install numpy, or name another interpreter: GLEANER_PYTHON"),
            "{stderr}"
        );
    }
}

#[test]
fn an_environment_that_is_not_used_is_named_with_the_way_out() {
    let folder = TempFolder::new();
    copy_lambda("tests/lambdas/misbehave/python", &folder, "lambda", |manifest| manifest);
    let lambda = folder.path().join("lambda");
    let python = InstalledPrograms::find()
        .and_then(|parts| parts.python(None))
        .expect("Python is installed");
    let environment = ["-m", "venv", "--copies", "--without-pip", ".venv"];
    assert!(
        Command::new(python)
            .args(environment)
            .current_dir(&lambda)
            .status()
            .expect("Python starts")
            .success()
    );
    let output = runtime()
        .env_remove("GLEANER_PYTHON")
        .arg("check")
        .arg(&lambda)
        .output()
        .expect("the program starts");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.contains("warning: cannot use the lambda's environment"), "{stderr}");
    assert!(
        stderr.contains("create the environment with `python3 -m venv`, which uses links"),
        "{stderr}"
    );
}

#[test]
fn a_lambda_whose_file_is_a_pipe_is_refused_without_waiting() {
    let folder = TempFolder::new();
    copy_lambda("tests/lambdas/misbehave/python", &folder, "lambda", |manifest| manifest);
    let entry = folder.path().join("lambda/build/main.py");
    std::fs::remove_file(&entry).unwrap();
    assert!(Command::new("mkfifo").arg(&entry).status().expect("`mkfifo` exists").success());
    let output = runtime()
        .arg("check")
        .arg(folder.path().join("lambda"))
        .output()
        .expect("the program starts");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(
        stderr.contains(
            "main.py`\n  cause: it is not a regular file\n  help:  put a file in its place"
        ),
        "{stderr}"
    );
}
