//! Programs to which a container refuses a system call.

use std::process::{Command, Output};

use gleaner_tests::denied::without;
use gleaner_tests::{TempFolder, program, root, sample_drive};

fn output_of(name: &str, args: &[&str]) -> (Option<i32>, [String; 2]) {
    let output = Command::new(program(name)).args(args).output().expect("the program starts");
    let Output { status, stdout, stderr } = output;
    (status.code(), [stdout, stderr].map(|it| String::from_utf8_lossy(&it).into_owned()))
}

#[test]
fn a_runtime_is_watched_without_a_handle_of_its_process() {
    let shim = || output_of("gleaner-shim", &["--", "sh", "-c", "exit 7"]);
    assert_eq!(without(libc::SYS_pidfd_open, shim).0, Some(7));
}

#[test]
fn doctor_names_what_is_refused() {
    let doctor = || output_of("gleaner", &["doctor"]);
    let (code, [stdout, _]) = without(libc::SYS_seccomp, doctor);
    for layer in ["system calls", "sockets"] {
        let error = format!("error    isolation: no lambda can run: {layer}: cannot install the");
        assert!(code == Some(1) && stdout.contains(&error), "{stdout}");
    }
    for (call, line) in [
        (libc::SYS_pidfd_getfd, "warning  socket filter: the system refuses `pidfd_open` or"),
        (libc::SYS_landlock_create_ruleset, "warning  isolation: files: a filter refuses Landlock"),
        (libc::SYS_prlimit64, "error    isolation: no lambda can run: needed calls: `prlimit64`: "),
    ] {
        let [stdout, _] = without(call, doctor).1;
        let can_run = !stdout.contains("no lambda can run");
        assert!(stdout.contains(line) && can_run == line.starts_with("warning"), "{stdout}");
    }
}

#[test]
fn a_component_is_replayed_without_seccomp_and_python_is_not() {
    let replay = |kind: &str| {
        let out = TempFolder::new();
        let lambda = root().join("examples/hello").join(kind);
        let paths = [&*lambda, &*sample_drive(), out.path()].map(|path| path.display().to_string());
        let args = ["replay", &paths[0], &paths[1], "--out", &paths[2]];
        without(libc::SYS_seccomp, || output_of("gleaner", &args))
    };
    let (code, [stdout, _]) = replay("rust");
    assert!(code == Some(0) && stdout.contains("(wasm)"), "{code:?}: {stdout}");
    let (code, [stdout, stderr]) = replay("python");
    let is_named = stderr.contains("cannot sandbox a lambda: `system calls`");
    assert!(code == Some(1) && stdout.is_empty() && is_named, "{code:?}: {stderr}");
}
