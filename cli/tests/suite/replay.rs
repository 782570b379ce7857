//! Tests of the program `gleaner replay` with a script as runtime.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use gleaner_protocol::ReplaySummary;
use tempfile::TempDir;

use crate::programs;

const SUMMARY: &str = concat!(
    r#"{"lambda":"x","version":"0.1.0","kind":"wasm","drive":["a.mcap"],"out":"OUT","wakes":2,"triggers":1,"faults":0,"#,
    r#""skipped":0,"missed_ticks":0,"out_of_order":0,"log_lines":0,"log_dropped":0,"triggers_refused":0,"backed_off":0,"start_ns":0,"#,
    r#""end_ns":3000000000,"wall_s":0.5,"run_s":0.25,"decode_s":0.0,"wakes_per_s":4.0,"peak_rss_bytes":1048576,"topics":[],"clips":0,"clips_replaced":0,"in_cooldown":0,"ignored":0,"damaged":null}"#
);
const DECISION: &str = concat!(
    r#"{"at_ns":1500000000,"cause":"tick","input":null,"topic":null,"writer":null,"seq":null,"#,
    r#""triggers":[{"kind":"event","label":"seen","score":0.5,"attributes":{}}],"fault":null,"fuel":1,"run_ns":2}"#
);

/// A folder with a script `gleaner-runtime`.
struct Installation(TempDir);

impl Installation {
    fn new(runtime: &str) -> Installation {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let report = SUMMARY
            .replacen('{', r#"{"report":"summary","#, 1)
            .replace("OUT", folder.to_str().unwrap());
        fs::write(folder.join("report"), report + "\n").unwrap();
        fs::write(folder.join("summary.json"), SUMMARY).unwrap();
        fs::write(folder.join("log.jsonl"), "").unwrap();
        fs::write(folder.join("decisions.jsonl"), format!("{DECISION}\n")).unwrap();
        let runtime = format!("#!/bin/sh\ncd '{}'\n{runtime}\n", folder.display());
        programs::script(&folder.join("gleaner-runtime"), &runtime);
        Installation(dir)
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut gleaner = Command::new(env!("CARGO_BIN_EXE_gleaner"));
        // The folder is given here, since `gleaner` does not use the path in the summary.
        gleaner
            .args(["replay", "dir", "a.mcap", "--out"])
            .arg(self.path())
            .args(arguments)
            .env("GLEANER_HOME", self.path())
            .stdin(Stdio::null());
        gleaner
    }

    fn replay(&self, arguments: &[&str]) -> Output {
        programs::output(&mut self.command(arguments))
    }
}

fn text(bytes: &[u8]) -> &str {
    str::from_utf8(bytes).unwrap()
}

#[test]
fn a_replay_ends_with_a_summary_and_without_colours_in_a_pipe() {
    let runtime = r#"echo '{"report":"progress","done":1,"total":2,"at_ns":5}'; cat report"#;
    let output = Installation::new(runtime).replay(&[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(text(&output.stdout).starts_with(
        "x 0.1.0 (wasm): 1 trigger in 2 wakes, 3.0 s of drive\n     1.500 s  seen  0.5\n"
    ));
    assert!(!text(&output.stdout).contains('\u{1b}'));
    assert_eq!(text(&output.stderr), "");
}

#[test]
fn json_is_the_summary_alone() {
    let installation = Installation::new("cat report");
    let output = installation.replay(&["--json"]);
    let expected = SUMMARY.replace("OUT", installation.path().to_str().unwrap());
    let line = text(&output.stdout);
    assert!(line.ends_with("}\n") && line.lines().count() == 1, "{line}");
    // Counts that an older runtime lacks are 0.
    assert_eq!(
        serde_json::from_str::<ReplaySummary>(line).unwrap(),
        serde_json::from_str::<ReplaySummary>(&expected).unwrap()
    );
}

#[test]
fn a_replay_writes_a_report_and_prints_its_path() {
    let installation = Installation::new("cat report");
    let page = installation.path().join("report.html");
    let output = installation.replay(&[]);
    let stdout = text(&output.stdout);
    assert!(stdout.ends_with(&format!("  report: {}\n", page.display())), "{stdout}");
    assert!(fs::read_to_string(&page).unwrap().contains(r#""labels":["seen"]"#));
    fs::remove_file(&page).unwrap();
    installation.replay(&["--json"]);
    assert!(page.exists());
    // A report of an earlier replay is removed.
    let output = installation.replay(&["--no-report"]);
    assert!(!page.exists() && !text(&output.stdout).contains("  report: "));
}

#[test]
fn a_report_that_cannot_be_written_is_an_error_beside_the_results() {
    let installation = Installation::new("cat report; exit 6");
    fs::create_dir(installation.path().join("report.html")).unwrap();
    let output = installation.replay(&[]);
    assert_eq!(output.status.code(), Some(6), "the exit code of the runtime");
    let stderr = text(&output.stderr);
    assert!(
        stderr.starts_with("error: cannot write the report") && stderr.contains("  help:  "),
        "{stderr}"
    );
    assert!(text(&output.stdout).contains("seen") && !text(&output.stdout).contains("  report: "));
}

#[test]
fn exit_code_and_messages_of_the_runtime_are_passed_on() {
    let output = Installation::new("echo 'error: no such drive' >&2; exit 2").replay(&[]);
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(text(&output.stderr), "error: no such drive\n");
    let output = Installation::new("cat report; exit 6").replay(&[]);
    assert_eq!(output.status.code(), Some(6));
    assert!(text(&output.stdout).contains("seen"));
}

#[test]
fn a_killed_runtime_is_reported_with_help() {
    let output = Installation::new("kill -9 $$").replay(&[]);
    assert_eq!(output.status.code(), Some(1));
    let stderr = text(&output.stderr);
    assert!(stderr.starts_with(
        "error: gleaner-runtime ended without a result (signal: 9 (SIGKILL))\n  help:  the "
    ));
    assert!(stderr.contains("dmesg"), "{stderr}");
}

/// A process that a lambda leaves running: it holds the pipe of reports open, creates `waited` at
/// its end, and ends early when the test has removed the folder.
const ORPHAN: &str = "(n=0; while [ -e report ] && [ $n -lt 300 ]; do sleep 0.1; n=$((n+1)); done; touch waited) 2>/dev/null &";

#[test]
fn a_process_left_running_does_not_delay_the_summary() {
    let installation = Installation::new(&format!("{ORPHAN} cat report"));
    let output = installation.replay(&[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(text(&output.stdout).contains("seen"));
    assert!(!installation.path().join("waited").exists());
}

#[test]
fn a_process_left_running_does_not_delay_a_failure() {
    let installation = Installation::new(&format!("{ORPHAN} echo error: no >&2; exit 5"));
    assert_eq!(installation.replay(&[]).status.code(), Some(5));
    assert!(!installation.path().join("waited").exists());
}

#[test]
fn a_runtime_of_another_version_is_stopped() {
    // The script never ends.
    let output = Installation::new(r#"while echo '{"report":"weather"}'; do :; done"#).replay(&[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        text(&output.stderr).contains("install the same version of gleaner and gleaner-runtime")
    );
}

#[test]
fn an_exit_code_without_an_error_message_is_not_trusted() {
    // A lambda can end the process with `os._exit` after any output.
    for (code, stderr) in
        [(0, ""), (3, ""), (6, ""), (3, "warning: an error: is near\n"), (101, "error: x\n")]
    {
        let output = Installation::new(&format!("printf '{stderr}' >&2; exit {code}")).replay(&[]);
        assert_eq!(output.status.code(), Some(1));
        let ended = format!(
            "error: gleaner-runtime ended without a result (exit status: {code})\n  help:  code of a lambda "
        );
        let whole = text(&output.stderr);
        assert!(whole.starts_with(&format!("{stderr}{ended}")), "{whole}");
    }
}

#[test]
fn a_crash_names_its_signal() {
    let output = Installation::new("kill -11 $$").replay(&[]);
    assert_eq!(output.status.code(), Some(1));
    let stderr = text(&output.stderr);
    assert!(stderr.contains("without a result (signal: 11 (SIGSEGV)"), "{stderr}");
}

/// Runs `gleaner` with these arguments; `OUT` stands for the folder of `installation`.
fn with_out(installation: &Installation, arguments: &[&str]) -> Output {
    let out = installation.path().to_str().unwrap();
    let arguments =
        arguments.iter().map(|argument| if *argument == "OUT" { out } else { *argument });
    // A generous limit for a command that takes some milliseconds.
    let mut gleaner = Command::new("timeout");
    gleaner.args(["120", env!("CARGO_BIN_EXE_gleaner")]).args(arguments).stdin(Stdio::null());
    programs::output(&mut gleaner)
}

#[test]
fn oversized_results_are_refused_with_their_name_and_bound() {
    let commands: [&[&str]; 3] = [
        &["report", "OUT"],
        &["diff", "OUT", "OUT"],
        &["diff", "OUT", "OUT", "--report", "/dev/null"],
    ];
    for (name, bound, refusing) in [
        ("decisions.jsonl", "32 GiB", &commands[..]),
        ("clips.jsonl", "32 GiB", &commands),
        ("log.jsonl", "32 GiB", &commands[..1]),
        ("summary.json", "4 MiB", &commands),
        ("signals.json", "32 MiB", &commands),
    ] {
        let installation = Installation::new(&format!("truncate -s 1T {name}; cat report"));
        let refused = format!("cause: it has 1099511627776 bytes; at most {bound} are read");
        let shown = installation.replay(&[]);
        let stderr = text(&shown.stderr);
        // The replay fails, since its report is incomplete.
        assert_eq!(shown.status.code(), Some(1), "{stderr}");
        assert!(stderr.contains(name) && stderr.contains(&refused), "{name}: {stderr}");
        for arguments in refusing {
            let output = with_out(&installation, arguments);
            let stderr = text(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
            assert!(
                stderr.contains(name) && stderr.contains(&refused) && stderr.contains("help:"),
                "{arguments:?}: {stderr}"
            );
        }
    }
}

#[test]
fn linked_results_are_not_shown() {
    let other = "the log of another lambda";
    for name in ["log.jsonl", "decisions.jsonl", "summary.json"] {
        let installation =
            Installation::new(&format!("echo '{other}' > other; ln -sf other {name}; cat report"));
        let page = installation.path().join("report.html");
        installation.replay(&[]);
        let output = with_out(&installation, &["report", "OUT"]);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        assert!(
            stderr.contains(name)
                && stderr.contains("cause: it is a link")
                && !stderr.contains(other),
            "{stderr}"
        );
        assert!(!page.exists(), "{name}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_failing_standard_output_is_an_error() {
    let installation = Installation::new("cat report");
    for arguments in [&[][..], &["--json"]] {
        let full = fs::File::options().write(true).open("/dev/full").unwrap();
        let mut replay = installation.command(arguments);
        let child = programs::start(replay.stdout(full).stderr(Stdio::piped()));
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        assert!(
            text(&output.stderr)
                .starts_with("error: cannot write to standard output\n  cause: No space left")
        );
    }
}
