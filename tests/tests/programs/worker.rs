//! In a replay, a Python lambda runs in a process that cannot write anything, and whose end does
//! not end the replay's process.

use std::io::Read;
use std::process::Stdio;
use std::time::{Duration, Instant};

use gleaner_lambda::FaultKind;
use gleaner_tests::drive::imu_only;
use gleaner_tests::live::descendants;
use gleaner_tests::{ReplayRun, TempFolder, replay, replay_to, root, runtime, verify};

/// From the table of exit codes.
const FAULTED: u8 = 6;

fn misbehave(folder: &TempFolder, behaviour: &str, target: &str, args: &[&str]) -> ReplayRun {
    let lambda = root().join("tests/lambdas/misbehave/python");
    let (behaviour, target) = (format!("behaviour={behaviour}"), format!("target={target}"));
    let settings = ["--set", &behaviour, "--set", &target];
    replay(&lambda, &[imu_only(folder, 1)], &[&settings, args].concat())
}

/// The only fault of a run that ended with its lambda's process: number of the wake, and message.
#[track_caller]
fn killed(run: &ReplayRun) -> (usize, &str) {
    let faults: Vec<_> =
        run.decisions.iter().enumerate().filter(|(_, decision)| decision.fault.is_some()).collect();
    let [(wake, decision)] = faults[..] else { panic!("{} faults: {}", faults.len(), run.stderr) };
    let fault = decision.fault.as_ref().unwrap();
    assert_eq!(fault.kind, FaultKind::Killed, "{}", fault.message);
    let summary = run.summary.as_ref().expect("a summary");
    assert_eq!(summary.stopped.as_ref(), Some(&fault.message));
    assert_eq!((summary.wakes, summary.faults), (wake as u64 + 1, 1));
    (wake + 1, &fault.message)
}

#[test]
fn the_process_of_a_python_lambda_can_write_no_file() {
    let (folder, out) = (TempFolder::new(), TempFolder::new());
    let lambda = root().join("tests/lambdas/misbehave/python");
    let journal = out.path().join("drive.journal");
    let target = format!("target={}", out.path().display());
    let args =
        ["--set", "behaviour=write", "--set", &target, "--journal", journal.to_str().unwrap()];
    let run = replay_to(out.path(), &lambda, &[imu_only(&folder, 1)], &args);
    let summary = run.must_exit(0).summary.as_ref().expect("a summary");
    assert!(summary.wakes > 0 && run.decisions.is_empty(), "{:?}", run.decisions);
}

#[test]
fn exit_code_and_output_of_the_lambda_are_not_those_of_the_replay() {
    let folder = TempFolder::new();
    let run = misbehave(&folder, "forge_end", "", &["--all"]);
    let (wake, why) = killed(run.must_exit(FAULTED));
    assert_eq!((wake, why), (3, "the lambda's process ended by itself, with exit code 7"));
    // Triggers of earlier wakes are kept, and its output is marked as the lambda's.
    assert_eq!(run.decisions.iter().map(|decision| decision.triggers.len()).sum::<usize>(), 2);
    assert!(run.stderr.contains("lambda: error: the drive is damaged"), "{}", run.stderr);
    assert!(!run.stderr.lines().any(|line| line.starts_with("error: the drive")), "{}", run.stderr);
}

#[test]
fn a_process_that_is_killed_leaves_a_fault_and_all_results_before_it() {
    let folder = TempFolder::new();
    let journal = folder.path().join("drive.journal");
    let journaled = ["--all", "--journal", journal.to_str().unwrap()];
    let run = misbehave(&folder, "kill_itself", "", &journaled);
    assert_eq!(
        killed(run.must_exit(FAULTED)),
        (3, "the lambda's process was ended by signal 9 (SIGKILL)")
    );
    // The journal has no end, and holds the wake in which the process died; verifying repeats it.
    let (lambda, drive) = (root().join("tests/lambdas/misbehave/python"), imu_only(&folder, 1));
    let args = [
        "replay".as_ref(),
        lambda.as_os_str(),
        drive.as_os_str(),
        "--verify".as_ref(),
        journal.as_os_str(),
    ];
    let verification = verify(&args);
    let verified = verification.verified.unwrap_or_else(|| panic!("{}", verification.stderr));
    assert_eq!((verification.exit, verified.wakes, verified.truncated), (0, 3, true));
}

#[test]
fn forged_messages_of_a_lambda_end_the_replay_and_are_named() {
    let done = r#"{"done":{"counts":[],"decode_ns":0,"curves":0,"curves_omitted":0}}"#;
    let woken = r#"{"woken":{"at_ns":17,"run_ns":1,"call":{"said":[0,0]},"looked":[]}}"#;
    for (message, named) in [
        ("no message", "expected"),
        (done, "an unexpected message"),
        (woken, "a wake at another time"),
        ("long", "a message of more than 4194304 bytes"),
    ] {
        let folder = TempFolder::new();
        let run = misbehave(&folder, "forge_messages", message, &["--all"]);
        let (wake, why) = killed(run.must_exit(FAULTED));
        assert!(
            why.starts_with("the lambda's process sent ") && why.contains(named),
            "{named}: {why}"
        );
        assert_eq!(wake, 3);
    }
}

#[test]
fn all_processes_of_a_killed_replay_end() {
    let folder = TempFolder::new();
    let mut command = runtime();
    command
        .arg("replay")
        .arg(root().join("tests/lambdas/misbehave/python"))
        .arg(imu_only(&folder, 600));
    command
        .args(["--set", "behaviour=sleep", "--out"])
        .arg(folder.path().join("out"))
        .stdout(Stdio::piped());
    let mut replay = command.spawn().expect("gleaner-runtime starts");
    let mut first = [0];
    replay.stdout.take().unwrap().read_exact(&mut first).expect("the replay reports its layers");
    let processes =
        [descendants(replay.id(), "gleaner-shim"), descendants(replay.id(), "start.py")].concat();
    assert_eq!(processes.len(), 2, "a shim and a worker");
    replay.kill().unwrap();
    replay.wait().unwrap();
    let lives = |pid: &u32| {
        std::fs::read(format!("/proc/{pid}/cmdline")).is_ok_and(|line| !line.is_empty())
    };
    let begun = Instant::now();
    while processes.iter().any(lives) {
        assert!(
            begun.elapsed() < Duration::from_secs(120),
            "a process of the replay is still running"
        );
        std::thread::sleep(Duration::from_millis(10));
    }
}
