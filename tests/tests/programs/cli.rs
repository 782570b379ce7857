//! The command `gleaner` with the real runtime, as users and scripts use it.

use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use gleaner_base::programs::InstalledPrograms;
use gleaner_protocol::ReplaySummary;
use gleaner_tests::drive::truncated;
use gleaner_tests::{LambdaCopy, TempFolder, program, root, sample_drive};

const OK: i32 = 0;
const USAGE: i32 = 2;
const FAULTED: i32 = 6;
const DAMAGED: i32 = 7;

/// `gleaner replay` of a lambda over a drive, with results in `out`.
fn replay(lambda: &Path, drive: &Path, out: &TempFolder, args: &[&str]) -> Command {
    let mut gleaner = Command::new(program("gleaner"));
    gleaner.arg("replay").arg(lambda).arg(drive).args(args).arg("--out").arg(out.path());
    // The tests' own cache, as for every replay of the tests.
    gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache"));
    gleaner
}

/// Output of a program that must end with `code`: standard output and standard error.
#[track_caller]
fn ends_with(code: i32, command: &mut Command) -> (String, String) {
    let Output { status, stdout, stderr } = command.output().expect("the program starts");
    let [stdout, stderr] = [stdout, stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    assert_eq!(status.code(), Some(code), "{stdout}{stderr}");
    (stdout, stderr)
}

fn hello() -> PathBuf {
    root().join("examples/hello/rust")
}

#[test]
fn variables_of_ros_2_that_gleaner_ignores_are_named() {
    let mut doctor = Command::new(program("gleaner"));
    doctor.arg("doctor").env("RMW_IMPLEMENTATION", "rmw_zenoh_cpp").env("ROS_STATIC_PEERS", "");
    let output = doctor.output().expect("the program starts");
    let found = String::from_utf8_lossy(&output.stdout);
    assert!(found.contains("middleware: DDS with multicast; ignored: RMW_"), "{found}");
}

#[test]
fn json_is_the_summary_of_the_replay() {
    let (out, drive) = (TempFolder::new(), sample_drive());
    let car = LambdaCopy::of("examples/hello/rust", |manifest| {
        manifest.replace("\"/imu/data\"", "\"/car/imu\"")
    });
    let args = ["--set", "brake_mps2=-1.4", "--remap", "/car/imu:=/imu/data", "--all", "--json"];
    let (stdout, stderr) = ends_with(OK, &mut replay(car.path(), &drive, &out, &args));
    let summary: ReplaySummary =
        serde_json::from_str(&stdout).expect("one summary and nothing else");
    assert_eq!((summary.lambda.as_str(), summary.triggers, summary.faults), ("hello", 3, 0));
    assert_eq!((&summary.drive, summary.out.as_path()), (&vec![drive], out.path()));
    assert_eq!(stderr, "");
    let decisions =
        std::fs::read_to_string(out.path().join("decisions.jsonl")).expect("decisions are written");
    assert_eq!(
        decisions.lines().count() as u64,
        summary.wakes,
        "with --all there is a line for each wake"
    );
}

#[test]
fn each_trigger_and_the_result_files_are_listed() {
    let out = TempFolder::new();
    let args = ["--set", "brake_mps2=-1.4"];
    let (stdout, _) = ends_with(OK, &mut replay(&hello(), &sample_drive(), &out, &args));
    assert!(stdout.starts_with("hello 0.1.0 (wasm): 3 triggers in "), "{stdout}");
    let expected =
        std::fs::read_to_string(root().join("examples/hello/expected.txt")).expect("expected.txt");
    for (line, expected) in stdout.lines().skip(1).zip(expected.lines()) {
        let words: Vec<_> = expected.split(' ').collect();
        assert_eq!(line.trim_start(), format!("{} s  {}  {}", words[0], words[1], words[2]));
    }
    assert_eq!(expected.lines().count(), 3);
    assert!(stdout.contains(&format!("{}: decisions.jsonl", out.path().display())), "{stdout}");
}

#[test]
fn a_mistake_is_explained_once_and_ends_with_its_code() {
    let out = TempFolder::new();
    let args = ["--set", "brake_mps=-1.4"];
    let (stdout, stderr) = ends_with(USAGE, &mut replay(&hello(), &sample_drive(), &out, &args));
    assert_eq!(stdout, "");
    assert!(stderr.starts_with("error: ") && stderr.contains("`brake_mps2`"), "{stderr}");
    assert_eq!(stderr.matches("error: ").count(), 1, "{stderr}");
}

#[test]
fn a_faulty_lambda_gets_a_summary_with_the_cause() {
    let (out, lambda) = (TempFolder::new(), root().join("tests/lambdas/misbehave/rust"));
    let args = ["--set", "behaviour=panic"];
    let (stdout, _) = ends_with(FAULTED, &mut replay(&lambda, &sample_drive(), &out, &args));
    assert!(stdout.contains(" faults\n") && stdout.contains("x trap: "), "{stdout}");
}

#[test]
fn a_damaged_drive_gets_a_summary_of_what_was_read() {
    let (folder, out) = (TempFolder::new(), TempFolder::new());
    let args = ["--set", "brake_mps2=-1.4"];
    let (stdout, _) =
        ends_with(DAMAGED, &mut replay(&hello(), &truncated(&folder, 0.5), &out, &args));
    assert!(stdout.contains("hard-brake") && stdout.contains("the drive is damaged"), "{stdout}");
}

#[test]
fn a_closed_standard_output_is_no_failure() {
    for args in [&[][..], &["--json"]] {
        let out = TempFolder::new();
        let mut gleaner = replay(&hello(), &sample_drive(), &out, args);
        let (reader, writer) = io::pipe().expect("a pipe");
        drop(reader);
        let (_, stderr) = ends_with(OK, gleaner.stdout(writer));
        assert_eq!(stderr, "");
        assert!(out.path().join("summary.json").is_file());
    }
}

/// Runs its arguments in a new terminal, and prints the terminal's output.
const TERMINAL: &str =
    "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))";

#[test]
fn on_a_terminal_an_error_is_shown_to_its_last_line() {
    let out = TempFolder::new();
    let typo = ["--set", "brake_mps=-1.4"];
    let (_, plain) = ends_with(USAGE, &mut replay(&hello(), &sample_drive(), &out, &typo));
    let python = InstalledPrograms::find().and_then(|parts| parts.python(None)).expect("a Python");
    // A single run could pass by chance.
    for _ in 0..5 {
        let gleaner = replay(&hello(), &sample_drive(), &out, &typo);
        let mut terminal = Command::new(&python);
        terminal.args(["-c", TERMINAL]).arg(gleaner.get_program()).args(gleaner.get_args());
        let (shown, _) = ends_with(
            USAGE,
            terminal.envs(gleaner.get_envs().filter_map(|(key, value)| Some((key, value?)))),
        );
        for line in plain.lines() {
            assert!(shown.contains(line), "no `{line}` in:\n{shown}");
        }
    }
}
