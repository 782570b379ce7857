//! Tests the shim as a program; small programs stand for a runtime.

use std::fs;
use std::hint::black_box;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use gleaner_protocol::process_stats::usage::ProcessUsage;
use gleaner_protocol::process_stats::{HEARTBEAT_ENV, Heartbeat, Share};
use gleaner_protocol::{ExitRecord, Holds, KillReason, Killed, Layer, Phase};
use rustix::process::{
    Pid, Resource, Rlimit, Signal, getpid, kill_process, setrlimit, test_kill_process,
};

const SHIM: &str = env!("CARGO_BIN_EXE_gleaner-shim");

struct RecordFile(PathBuf);

impl RecordFile {
    fn of(test: &str) -> Self {
        Self(std::env::temp_dir().join(format!("gleaner-shim-{}-{test}.json", std::process::id())))
    }

    fn read(&self) -> ExitRecord {
        ExitRecord::read(&self.0).unwrap()
    }
}

impl Drop for RecordFile {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

fn shim(record: &RecordFile, program: &[&str]) -> Command {
    let mut shim = Command::new(SHIM);
    shim.arg("--exit-record").arg(&record.0).arg("--").args(program);
    shim
}

fn run(record: &RecordFile, script: &str) -> Output {
    shim(record, &["sh", "-c", script]).output().unwrap()
}

/// Starts `script`, and waits for its first line.
fn start(record: &RecordFile, script: &str) -> (Child, String) {
    let mut child = shim(record, &["sh", "-c", script]).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (child, line.trim().to_owned())
}

fn pid(number: impl TryInto<i32>) -> Pid {
    number.try_into().ok().and_then(Pid::from_raw).unwrap()
}

#[test]
fn the_exit_code_is_that_of_the_runtime_and_is_recorded() {
    let record = RecordFile::of("code");
    assert_eq!(run(&record, "exit 7").status.code(), Some(7));
    let written = record.read();
    assert_eq!(
        (written.code, written.signal, written.killed, written.orphans),
        (Some(7), None, None, 0)
    );
    assert!(written.ended_ns > written.started_ns && written.max_rss_bytes > 0);
    assert!(!written.end_requested);
}

#[test]
fn a_runtime_that_crashes_takes_its_shim_along_by_the_same_signal() {
    use std::os::unix::process::ExitStatusExt;
    let record = RecordFile::of("crash");
    assert_eq!(run(&record, "kill -ABRT $$").status.signal(), Some(6));
    assert_eq!(record.read().signal, Some(6));
}

#[test]
fn a_runtime_has_no_sockets_from_its_first_instruction_on() {
    let record = RecordFile::of("sockets");
    let connects = "exec 3<>/dev/udp/127.0.0.1/9 && echo connected";
    let output = shim(&record, &["bash", "-c", connects]).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.stdout.is_empty() && error.contains("Operation not permitted"), "{error}");
}

#[test]
fn a_signal_to_the_shim_reaches_the_runtime() {
    let record = RecordFile::of("term");
    let (mut shim, _) =
        start(&record, "trap 'exit 5' TERM; echo ready; while :; do sleep 0.01; done");
    kill_process(pid(shim.id()), Signal::TERM).unwrap();
    assert_eq!(shim.wait().unwrap().code(), Some(5));
    assert_eq!((record.read().code, record.read().end_requested), (Some(5), true));
}

#[test]
fn orphans_of_a_runtime_are_killed_even_in_a_session_of_their_own() {
    let record = RecordFile::of("left");
    let output = run(&record, "setsid sleep 1000 >/dev/null 2>&1 & echo $!");
    let left: i32 = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
    assert!(test_kill_process(pid(left)).is_err(), "process {left} still lives");
    assert!(record.read().orphans >= 1);
}

/// Runs the test `name` of this program below a shim, which kills it. Returns the reason, and the
/// standard error.
#[track_caller]
fn killed(name: &str) -> (Killed, String) {
    let record = RecordFile::of(name);
    let me = std::env::current_exe().unwrap();
    let runtime = [me.to_str().unwrap(), "--exact", name];
    let output = shim(&record, &runtime).stdout(Stdio::null()).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(6), "{stderr}");
    let killed = record.read().killed.unwrap();
    assert!(
        stderr.contains(&format!("its process {}", killed.sentence()))
            && stderr.contains(killed.help()),
        "{stderr}"
    );
    (killed, stderr)
}

/// Returns the page of the shim, in a test that [`killed`] starts as a runtime. Run directly, such
/// a test returns at once.
fn below_shim() -> Option<Heartbeat> {
    std::env::var_os(HEARTBEAT_ENV).map(|_| Heartbeat::inherited().unwrap())
}

fn hang() -> ! {
    loop {
        std::thread::park();
    }
}

#[test]
fn a_runtime_that_does_not_return_is_killed_and_the_record_has_its_activity() {
    let (killed, _) = killed("a_runtime_that_hangs");
    assert_eq!((killed.phase, killed.at_ns, killed.allowed_ns), (Phase::Wake, 42, 50_000_000));
    assert!(
        killed.reason == KillReason::Overdue && killed.ran_ns >= killed.allowed_ns,
        "{killed:?}"
    );
}

#[test]
fn a_runtime_that_hangs() {
    let Some(heartbeat) = below_shim() else { return };
    let _busy = heartbeat.busy(Phase::Wake, Duration::from_millis(50), 42);
    hang();
}

#[test]
fn a_runtime_that_was_stopped_between_two_wakes_is_killed_though_nothing_is_overdue() {
    let (killed, stderr) = killed("a_runtime_that_stops_itself");
    assert_eq!((killed.phase, killed.reason), (Phase::Housekeeping, KillReason::Stopped));
    assert!(
        killed.ran_ns >= killed.allowed_ns && !stderr.contains("deadline"),
        "{killed:?}, {stderr}"
    );
}

#[test]
fn a_runtime_that_stops_itself() {
    let Some(heartbeat) = below_shim() else { return };
    heartbeat.alive(Duration::from_secs(3600));
    kill_process(getpid(), Signal::STOP).unwrap();
    hang();
}

#[test]
fn a_runtime_that_keeps_more_memory_than_its_lambda_may_is_killed_with_both_numbers() {
    const MAY: u64 = 1 << 20;
    let (killed, _) = killed("a_runtime_that_keeps_memory");
    let KillReason::Memory { used, allowed } = killed.reason else { panic!("{killed:?}") };
    assert!(allowed == MAY && used > 40 << 20, "{used} of {allowed}");
}

#[test]
fn a_runtime_that_keeps_memory() {
    let Some(heartbeat) = below_shim() else { return };
    let base = ProcessUsage::of(None).unwrap().held;
    heartbeat.set_share(Share { base, most: 1 << 20 });
    let kept = black_box(vec![1_u8; 48 << 20]);
    heartbeat.alive(Duration::from_secs(3600));
    black_box(&kept);
    hang();
}

#[test]
fn memory_that_the_data_limit_no_longer_counts_is_still_counted() {
    let (killed, _) = killed("a_runtime_above_its_data_limit");
    let KillReason::Memory { used, allowed } = killed.reason else { panic!("{killed:?}") };
    assert!(allowed == 8 << 20 && used > 128 << 20, "{used} of {allowed}");
}

#[test]
fn a_runtime_above_its_data_limit() {
    let Some(heartbeat) = below_shim() else { return };
    let kept = black_box(vec![1_u8; 128 << 20]);
    let bound = Some(8 << 20);
    setrlimit(Resource::Data, Rlimit { current: bound, maximum: bound }).unwrap();
    heartbeat.alive(Duration::from_secs(3600));
    black_box(&kept);
    hang();
}

#[test]
fn secrets_of_the_starter_are_not_passed_on() {
    let record = RecordFile::of("secrets");
    let output = shim(&record, &["sh", "-c", "env"])
        .env("CLOUD_TOKEN", "hush")
        .env("GLEANER_X", "y")
        .output()
        .unwrap();
    let environment = String::from_utf8(output.stdout).unwrap();
    assert!(!environment.contains("hush") && environment.contains("GLEANER_X=y"), "{environment}");
}

#[test]
fn the_error_names_a_missing_program() {
    let record = RecordFile::of("missing");
    let output = shim(&record, &["/no/such/runtime"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8(output.stderr).unwrap().contains("cannot start `/no/such/runtime`"));
}

#[test]
fn every_layer_reports_whether_it_holds() {
    let output = Command::new(SHIM).arg("--layers").output().unwrap();
    let layers: Vec<Layer> = serde_json::from_slice(&output.stdout).unwrap();
    let names: Vec<_> = layers.iter().map(|layer| layer.name.as_str()).collect();
    let (first, later) = (
        ["new privileges", "capabilities", "system calls", "hard deadline", "control group"],
        ["files", "interpreter start", "processes", "sockets", "shared resources", "memory"],
    );
    for name in first.into_iter().chain(later) {
        assert!(names.contains(&name), "{name} is missing in {names:?}");
    }
    // Every Linux that Gleaner runs on has these, but for Landlock and control groups.
    for layer in
        layers.iter().filter(|layer| !["files", "control group"].contains(&layer.name.as_str()))
    {
        assert_eq!(layer.holds, Holds::Yes, "{layer:?}");
    }
}

#[test]
fn no_program_is_started_for_a_starter_that_has_ended() {
    let folder = std::env::temp_dir().join(format!("gleaner-shim-starter-{}", std::process::id()));
    let output =
        Command::new(SHIM).args(["--starter=1", "--", "/bin/mkdir"]).arg(&folder).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(
        String::from_utf8(output.stderr)
            .unwrap()
            .contains("process 1 is not the parent of gleaner-shim")
    );
    assert!(!folder.exists());
    let starter = format!("--starter={}", std::process::id());
    let status =
        Command::new(SHIM).args([&starter, "--", "/bin/mkdir"]).arg(&folder).status().unwrap();
    assert!(status.success());
    std::fs::remove_dir(folder).unwrap();
}

#[test]
fn root_loses_its_capabilities_but_those_on_files() {
    let output = Command::new(SHIM).args(["--", "/bin/cat", "/proc/self/status"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    // The capabilities that stay: reading and writing files of other users.
    const FILES: u64 = 1 << 1 | 1 << 2;
    for set in ["CapInh:", "CapPrm:", "CapEff:", "CapAmb:"] {
        let bits = text
            .lines()
            .find_map(|line| line.strip_prefix(set))
            .expect("a line of this set")
            .trim();
        assert_eq!(u64::from_str_radix(bits, 16).unwrap() & !FILES, 0, "{set} {bits}");
    }
}
