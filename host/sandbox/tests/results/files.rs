//! Tests results in files.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use gleaner_lambda::{Decision, FaultKind, LogLine, RESULT_ITEM_MAX};
use gleaner_protocol::{LiveStatus, Report};
use rustix::process::{Pid, Signal, kill_process};

use crate::{ITEMS, ResultsFolder, SHIM, stderr};

impl ResultsFolder {
    fn decisions(&self) -> Vec<Decision> {
        let text = fs::read_to_string(self.out().join("decisions.jsonl")).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// Times of the lines of the log.
    fn logged(&self) -> Vec<i64> {
        let text = fs::read_to_string(self.out().join("log.jsonl")).unwrap();
        text.lines().map(|line| serde_json::from_str::<LogLine>(line).unwrap().at_ns).collect()
    }
}

fn shim(out: &Path, script: &str) -> Command {
    let mut shim = Command::new(SHIM);
    shim.arg("--results").arg(out).args(["--", "bash", "-c", &format!("{ITEMS}{script}")]);
    shim
}

fn run(folder: &ResultsFolder, script: &str) -> Output {
    shim(&folder.out(), script).output().unwrap()
}

/// Starts `script`, and waits for its first line.
fn start(folder: &ResultsFolder, script: &str) -> Child {
    let mut shim = shim(&folder.out(), script);
    let mut child =
        shim.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    child
}

/// Decisions that the shim reported to its starter.
fn reported(output: &Output) -> Vec<Decision> {
    let text = String::from_utf8_lossy(&output.stdout);
    let reports = text.lines().filter_map(|line| serde_json::from_str(line).ok());
    reports
        .filter_map(
            |report| if let Report::Decision(decision) = report { Some(*decision) } else { None },
        )
        .collect()
}

#[test]
fn items_of_a_killed_runtime_are_written_and_so_is_the_wake_in_progress() {
    let folder = ResultsFolder::of("killed");
    let output = run(
        &folder,
        "woken; for n in $(seq 200); do tick $n; log $n; done; printf '{\"rep'; kill -KILL $$",
    );
    let decisions = folder.decisions();
    assert_eq!(decisions.len(), 201);
    assert_eq!(folder.logged(), (1..=200).collect::<Vec<_>>());
    let last = decisions.last().unwrap();
    let fault = last.fault.as_ref().unwrap();
    assert_eq!(
        (fault.kind, last.input.as_deref(), last.topic.as_deref()),
        (FaultKind::Killed, Some("camera"), Some("/camera"))
    );
    assert!(fault.message.contains("was ended by signal 9"), "{}", fault.message);
    assert_eq!(
        reported(&output),
        std::slice::from_ref(last),
        "{}",
        String::from_utf8_lossy(&output.stdout)
    );
    assert!(!folder.out().join("summary.json").exists());
}

#[test]
fn a_runtime_that_was_asked_to_end_or_never_entered_its_lambda_has_lost_no_wake() {
    let folder = ResultsFolder::of("asked");
    let shim = start(&folder, "woken; tick 1; echo; read -r line");
    kill_process(Pid::from_raw(i32::try_from(shim.id()).unwrap()).unwrap(), Signal::TERM).unwrap();
    let output = shim.wait_with_output().unwrap();
    assert_eq!(folder.decisions().len(), 1, "{}", stderr(&output));
    let folder = ResultsFolder::of("not-entered");
    fs::create_dir(folder.out()).unwrap();
    fs::write(folder.out().join("log.jsonl"), "of an earlier run").unwrap();
    let output = run(&folder, "log 1; kill -SEGV $$");
    assert!(
        stderr(&output).contains("the first item must be `woken`") && reported(&output).is_empty(),
        "{}",
        stderr(&output)
    );
    // Its results have not begun, so those of the earlier run are still there.
    assert_eq!(fs::read_to_string(folder.out().join("log.jsonl")).unwrap(), "of an earlier run");
}

#[test]
fn invalid_items_are_counted_and_logged_once_and_later_ones_are_written() {
    let folder = ResultsFolder::of("garbage");
    let garbage = [
        "x",
        "{}",
        "[[[[",
        r#"{"decision":{"at_ns":1}}"#,
        r#"{"decision":{"at_ns":1e999,"cause":"tick","triggers":[],"run_ns":1}}"#,
        r#"{"log":{"at_ns":1,"level":"info","message":"m"},"log":{}}"#,
        r#"{"\u001b[31m":1}"#,
        r#"{"last":{}}"#,
        r#"{"woken":{"cause":"tick"}}"#,
    ];
    let items: String = garbage.iter().map(|item| format!("item '{item}'\n")).collect();
    let pipe = "\"/proc/self/fd/$GLEANER_RESULTS\"";
    let script = format!(
        "woken\n{items}printf '\\377\\376\\n' > {pipe}; head -c {} /dev/zero > {pipe}; item; \
         tick 7; log 8; last; printf half > {pipe}; asked",
        3 * RESULT_ITEM_MAX
    );
    let output = run(&folder, &script);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let at: Vec<_> = folder.decisions().iter().map(|decision| decision.at_ns).collect();
    assert_eq!((at, folder.logged()), (vec![7], vec![8]));
    let summary: LiveStatus =
        serde_json::from_slice(&fs::read(folder.out().join("summary.json")).unwrap()).unwrap();
    // The runtime's own count, a line that is not text, one that is too long, and an unfinished
    // one.
    assert_eq!(summary.unwritten, 5 + garbage.len() as u64 + 3);
    let stderr_text = stderr(&output);
    assert_eq!(stderr_text.matches("invalid result item").count(), 1, "{stderr_text}");
    assert!(!stderr_text.contains('\u{1b}'), "{stderr_text:?}");
}

#[test]
fn an_endless_line_takes_no_memory_and_later_lines_are_written() {
    let folder = ResultsFolder::of("endless");
    let pipe = "\"/proc/self/fd/$GLEANER_RESULTS\"";
    let mut shim = start(
        &folder,
        &format!("woken; head -c 50000000 /dev/zero > {pipe}; item; tick 7; echo; read -r line"),
    );
    let status = fs::read_to_string(format!("/proc/{}/status", shim.id())).unwrap();
    let most = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .unwrap()
        .trim()
        .trim_end_matches(" kB");
    assert!(most.parse::<u64>().unwrap() < 32 << 10, "{most} KiB");
    shim.stdin.take().unwrap().write_all(b"\n").unwrap();
    assert!(shim.wait().unwrap().success());
    assert_eq!(folder.decisions()[0].at_ns, 7);
}

#[test]
fn a_flood_does_not_keep_a_hanging_runtime_alive() {
    let folder = ResultsFolder::of("flood");
    let pipe = "/proc/self/fd/$GLEANER_RESULTS";
    let shim = start(
        &folder,
        &format!("woken; yes | head -n 100000 > {pipe}; (exec yes > {pipe}) & echo; read -r line"),
    );
    kill_process(Pid::from_raw(i32::try_from(shim.id()).unwrap()).unwrap(), Signal::TERM).unwrap();
    // `yes` is an orphan, and is killed.
    let output = shim.wait_with_output().unwrap();
    assert!(stderr(&output).contains("invalid result item"), "{}", stderr(&output));
}

#[test]
fn results_are_replaced_or_appended_as_requested() {
    let folder = ResultsFolder::of("again");
    let run = |script: &str, again: bool| {
        let mut shim = Command::new(SHIM);
        shim.arg("--results").arg(folder.out()).args(again.then_some("--again"));
        assert!(
            shim.args(["--", "bash", "-c", &format!("{ITEMS}woken; {script}")])
                .output()
                .unwrap()
                .status
                .success()
        );
        folder.logged()
    };
    assert_eq!(run("log 1", false), [1]);
    assert_eq!(run("log 2", true), [1, 2]);
    assert_eq!(run("log 3", false), [3]);
}

/// A file at its size limit refuses bytes, like a full disk, until it is truncated.
#[test]
fn lines_that_a_full_disk_refuses_are_counted_and_later_ones_are_written() {
    let folder = ResultsFolder::of("full");
    let stderr_text = folder.0.join("stderr");
    let script = format!(
        "woken; until grep -q 'are retried' {stderr_text}; do for n in {{1..200}}; do \
         log 1; done; done; : > {out}/log.jsonl; \
         until grep -q 'written again' {stderr_text}; do log 2; done; log 2; asked",
        stderr_text = stderr_text.display(),
        out = folder.out().display()
    );
    let output = Command::new("bash")
        .args(["-c", "trap '' XFSZ; ulimit -f 256; exec \"$@\"", "bash", SHIM, "--results"])
        .arg(folder.out())
        .args(["--", "bash", "-c", &format!("{ITEMS}{script}")])
        .stderr(fs::File::create(&stderr_text).unwrap())
        .output()
        .unwrap();
    let stderr_text = fs::read_to_string(&stderr_text).unwrap();
    // The runtime ended without errors, and does not know that something is missing.
    assert_eq!(output.status.code(), Some(1), "{stderr_text}");
    assert!(
        stderr_text.contains("results are written again")
            && stderr_text.contains("log.jsonl")
            && stderr_text.contains("make room"),
        "{stderr_text}"
    );
    assert!(folder.logged().ends_with(&[2]));
}

#[test]
fn results_that_cannot_be_opened_are_an_error_before_the_program_starts() {
    let folder = ResultsFolder::of("link");
    fs::create_dir(folder.out()).unwrap();
    let precious = folder.0.join("precious");
    fs::write(&precious, "precious").unwrap();
    std::os::unix::fs::symlink(&precious, folder.out().join("log.jsonl")).unwrap();
    let mut shim = Command::new(SHIM);
    shim.arg("--results")
        .arg(folder.out())
        .args(["--again", "--", "touch"])
        .arg(folder.0.join("started"));
    let output = shim.output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("it is a link"), "{}", stderr(&output));
    assert!(!folder.0.join("started").exists());
    assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
}

#[test]
fn after_a_killed_shim_the_next_one_appends_whole_lines() {
    let folder = ResultsFolder::of("killed-shim");
    let mut killed =
        start(&folder, "woken; (while :; do log 1; tick 2; done) & echo; read -r line");
    while !fs::metadata(folder.out().join("log.jsonl")).is_ok_and(|log| log.len() >= 10_000) {
        std::thread::yield_now();
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    // The system may have written only a part of the last line: the kill ended the write.
    let mut next = Command::new(SHIM);
    next.arg("--results").arg(folder.out()).args([
        "--again",
        "--",
        "bash",
        "-c",
        &format!("{ITEMS}woken; log 7"),
    ]);
    assert!(next.output().unwrap().status.success());
    let logged = folder.logged();
    assert!(logged.len() > 100);
    assert_eq!(logged.last(), Some(&7));
    assert!(fs::read(folder.out().join("log.jsonl")).unwrap().ends_with(b"\n"));
}
