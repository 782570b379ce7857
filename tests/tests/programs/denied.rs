//! Programs to which a container refuses a system call.

use std::process::{Command, Output};

use gleaner_tests::denied::without;
use gleaner_tests::program;

fn output_of(name: &str, args: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(program(name)).args(args).output().expect("the program starts");
    let Output { status, stdout, .. } = output;
    (status.code(), String::from_utf8_lossy(&stdout).into_owned())
}

#[test]
fn a_runtime_is_watched_without_a_handle_of_its_process() {
    let shim = || output_of("gleaner-shim", &["--", "sh", "-c", "exit 7"]);
    assert_eq!(without(libc::SYS_pidfd_open, shim).0, Some(7));
}

#[test]
fn doctor_names_what_is_refused() {
    let doctor = || output_of("gleaner", &["doctor"]);
    let (code, stdout) = without(libc::SYS_seccomp, doctor);
    for layer in ["system calls", "sockets"] {
        let error = format!("error    isolation: no lambda can run: {layer}: cannot install the");
        assert!(code == Some(1) && stdout.contains(&error), "{stdout}");
    }
    let stdout = without(libc::SYS_pidfd_getfd, doctor).1;
    let warning = "warning  socket filter: the system refuses `pidfd_open` or `pidfd_getfd`";
    assert!(stdout.contains(warning) && !stdout.contains("no lambda can run"), "{stdout}");
}
