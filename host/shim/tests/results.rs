//! Results of a live lambda, written by the shim: small programs stand for a runtime, and write
//! into the pipe whatever they like.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use gleaner_lambda::{Decision, FaultKind, LogLine, PAGE_BYTES};
use gleaner_protocol::{Live, Report};
use rustix::process::{Pid, Signal, kill_process};

const SHIM: &str = env!("CARGO_BIN_EXE_gleaner-shim");

/// What a script begins with: `page TEXT` writes one, `woken` the first one, `log N` a line of the
/// log, `tick N` a decision without a trigger. `asked` has the script asked to end, by its shim.
const PAGES: &str = r#"
page() { printf '%s\n' "$1" > "/proc/self/fd/$GLEANER_RESULTS"; }
log() { page '{"log":{"at_ns":'$1',"level":"info","message":"m"}}'; }
tick() { page '{"decision":{"at_ns":'$1',"cause":"tick","triggers":[],"run_ns":1}}'; }
woken() { page '{"woken":{"cause":"event","input":"camera","topic":"/camera"}}'; }
asked() { local is=; trap 'is=1' TERM; kill -TERM $PPID; until [ "$is" ]; do sleep 0.01; done; }
last() { page '{"last":{"lambda":"l","version":"1.0.0","kind":"wasm","out":"o","restarts":0,"up_s":1.0,"wakes":2,"triggers":0,"faults":0,"skipped":0,"missed_ticks":0,"log_lines":0,"log_dropped":0,"triggers_refused":0,"backed_off":0,"unwritten":5,"topics":[],"network":{"domain":0,"participants":0,"buffer_asked":0,"buffer_granted":0,"socket_drops":0,"filtered":0},"rss_bytes":0,"cpu_s":0.0}}'; }
"#;

/// A folder for one test, removed with it.
struct Folder(PathBuf);

impl Folder {
    fn of(test: &str) -> Self {
        let path = std::env::temp_dir()
            .join(format!("gleaner-shim-results-{}-{test}", std::process::id()));
        fs::create_dir(&path).unwrap();
        Self(path)
    }

    fn out(&self) -> PathBuf {
        self.0.join("out")
    }

    fn decisions(&self) -> Vec<Decision> {
        let text = fs::read_to_string(self.out().join("decisions.jsonl")).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// The times of the lines of the log.
    fn logged(&self) -> Vec<i64> {
        let text = fs::read_to_string(self.out().join("log.jsonl")).unwrap();
        text.lines().map(|line| serde_json::from_str::<LogLine>(line).unwrap().at_ns).collect()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn shim(out: &Path, script: &str) -> Command {
    let mut shim = Command::new(SHIM);
    shim.arg("--results").arg(out).args(["--", "bash", "-c", &format!("{PAGES}{script}")]);
    shim
}

/// Runs `script` to its end.
fn run(folder: &Folder, script: &str) -> Output {
    shim(&folder.out(), script).output().unwrap()
}

/// Starts `script`, and waits for its first line.
fn start(folder: &Folder, script: &str) -> Child {
    let mut shim = shim(&folder.out(), script);
    let mut child =
        shim.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    child
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// How the shim reports a decision to its starter.
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
fn what_a_killed_runtime_left_in_the_pipe_is_written_and_so_is_the_wake_that_ended_with_it() {
    let folder = Folder::of("killed");
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
    let folder = Folder::of("asked");
    let shim = start(&folder, "woken; tick 1; echo; read -r line");
    kill_process(Pid::from_raw(i32::try_from(shim.id()).unwrap()).unwrap(), Signal::TERM).unwrap();
    let output = shim.wait_with_output().unwrap();
    assert_eq!(folder.decisions().len(), 1, "{}", stderr(&output));
    let folder = Folder::of("not-entered");
    fs::create_dir(folder.out()).unwrap();
    fs::write(folder.out().join("log.jsonl"), "of an earlier run").unwrap();
    let output = run(&folder, "log 1; kill -SEGV $$");
    assert!(
        stderr(&output).contains("another one comes first") && reported(&output).is_empty(),
        "{}",
        stderr(&output)
    );
    // Its results have not begun, so that those of the run before are still there.
    assert_eq!(fs::read_to_string(folder.out().join("log.jsonl")).unwrap(), "of an earlier run");
}

#[test]
fn what_is_no_page_is_counted_and_named_once_and_what_comes_after_it_is_written() {
    let folder = Folder::of("garbage");
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
    let pages: String = garbage.iter().map(|page| format!("page '{page}'\n")).collect();
    let pipe = "\"/proc/self/fd/$GLEANER_RESULTS\"";
    let script = format!(
        "woken\n{pages}printf '\\377\\376\\n' > {pipe}; head -c {} /dev/zero > {pipe}; page; tick 7; log 8; last; printf half > {pipe}; asked",
        3 * PAGE_BYTES
    );
    let output = run(&folder, &script);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let at: Vec<_> = folder.decisions().iter().map(|decision| decision.at_ns).collect();
    assert_eq!((at, folder.logged()), (vec![7], vec![8]));
    let summary: Live =
        serde_json::from_slice(&fs::read(folder.out().join("summary.json")).unwrap()).unwrap();
    // What the runtime counted itself, one that is no text, one that is too long, and a half.
    assert_eq!(summary.unwritten, 5 + garbage.len() as u64 + 3);
    let said = stderr(&output);
    assert_eq!(said.matches("is no page of results").count(), 1, "{said}");
    assert!(!said.contains('\u{1b}'), "{said:?}");
}

#[test]
fn an_endless_line_takes_no_memory_and_does_not_keep_the_shim_from_what_follows() {
    let folder = Folder::of("endless");
    let pipe = "\"/proc/self/fd/$GLEANER_RESULTS\"";
    let mut shim = start(
        &folder,
        &format!("woken; head -c 50000000 /dev/zero > {pipe}; page; tick 7; echo; read -r line"),
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
fn a_flood_does_not_keep_a_runtime_that_hangs_from_being_ended() {
    let folder = Folder::of("flood");
    let pipe = "/proc/self/fd/$GLEANER_RESULTS";
    let shim = start(
        &folder,
        &format!("woken; yes | head -n 100000 > {pipe}; (exec yes > {pipe}) & echo; read -r line"),
    );
    kill_process(Pid::from_raw(i32::try_from(shim.id()).unwrap()).unwrap(), Signal::TERM).unwrap();
    // `yes` is left behind, and ended.
    let output = shim.wait_with_output().unwrap();
    assert!(stderr(&output).contains("is no page of results"), "{}", stderr(&output));
}

#[test]
fn results_begin_again_or_go_on_as_the_starter_says() {
    let folder = Folder::of("again");
    let run = |script: &str, again: bool| {
        let mut shim = Command::new(SHIM);
        shim.arg("--results").arg(folder.out()).args(again.then_some("--again"));
        assert!(
            shim.args(["--", "bash", "-c", &format!("{PAGES}woken; {script}")])
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

/// A file that may have no more bytes refuses them, as a full disk does; until it is cut.
#[test]
fn what_a_full_disk_refuses_is_counted_and_what_comes_later_is_written_again() {
    let folder = Folder::of("full");
    let said = folder.0.join("stderr");
    let script = format!(
        "woken; until grep -q 'tried again' {said}; do for n in {{1..200}}; do log 1; done; done; : > {out}/log.jsonl; \
         until grep -q 'written again' {said}; do log 2; done; asked",
        said = said.display(),
        out = folder.out().display()
    );
    let output = Command::new("bash")
        .args(["-c", "trap '' XFSZ; ulimit -f 256; exec \"$@\"", "bash", SHIM, "--results"])
        .arg(folder.out())
        .args(["--", "bash", "-c", &format!("{PAGES}{script}")])
        .stderr(fs::File::create(&said).unwrap())
        .output()
        .unwrap();
    let said = fs::read_to_string(&said).unwrap();
    // The runtime ended well, and does not know that something is missing.
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("results are written again")
            && said.contains("log.jsonl")
            && said.contains("make room"),
        "{said}"
    );
    assert!(folder.logged().ends_with(&[2]));
}

#[test]
fn results_that_cannot_begin_are_an_error_before_anything_is_started() {
    let folder = Folder::of("link");
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
fn after_a_shim_that_was_killed_the_next_goes_on_with_whole_lines() {
    let folder = Folder::of("killed-shim");
    let mut killed =
        start(&folder, "woken; (while :; do log 1; tick 2; done) & echo; read -r line");
    while fs::metadata(folder.out().join("log.jsonl")).is_ok_and(|log| log.len() < 10_000) {
        std::thread::yield_now();
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    // The system may have taken only a part of the last line: the kill ended the write.
    let mut next = Command::new(SHIM);
    next.arg("--results").arg(folder.out()).args([
        "--again",
        "--",
        "bash",
        "-c",
        &format!("{PAGES}woken; log 7"),
    ]);
    assert!(next.output().unwrap().status.success());
    let logged = folder.logged();
    assert!(logged.len() > 100);
    assert_eq!(logged.last(), Some(&7));
    assert!(fs::read(folder.out().join("log.jsonl")).unwrap().ends_with(b"\n"));
}
