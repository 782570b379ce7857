//! The shim as a program, around small programs that stand for a runtime.

use std::fs;
use std::hint::black_box;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use gleaner_protocol::{Doing, ExitRecord, Holds, Killed, Layer, Why};
use gleaner_vitals::usage::Process;
use gleaner_vitals::{PULSE_ENV, Pulse, Share};
use rustix::process::{
    Pid, Resource, Rlimit, Signal, getpid, kill_process, setrlimit, test_kill_process,
};

const SHIM: &str = env!("CARGO_BIN_EXE_gleaner-shim");

/// Where the record of one test goes; removed with it.
struct Record(PathBuf);

impl Record {
    fn of(test: &str) -> Self {
        Self(std::env::temp_dir().join(format!("gleaner-shim-{}-{test}.json", std::process::id())))
    }

    fn read(&self) -> ExitRecord {
        ExitRecord::read(&self.0).unwrap()
    }
}

impl Drop for Record {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

fn shim(record: &Record, program: &[&str]) -> Command {
    let mut shim = Command::new(SHIM);
    shim.arg("--exit-record").arg(&record.0).arg("--").args(program);
    shim
}

fn run(record: &Record, script: &str) -> Output {
    shim(record, &["sh", "-c", script]).output().unwrap()
}

/// Starts `script`, and waits for its first line.
fn start(record: &Record, script: &str) -> (Child, String) {
    let mut child = shim(record, &["sh", "-c", script]).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (child, line.trim().to_owned())
}

fn pid(number: impl TryInto<i32>) -> Pid {
    number.try_into().ok().and_then(Pid::from_raw).unwrap()
}

#[test]
fn the_exit_code_is_that_of_the_runtime_and_is_written_down() {
    let record = Record::of("code");
    assert_eq!(run(&record, "exit 7").status.code(), Some(7));
    let written = record.read();
    assert_eq!(
        (written.code, written.signal, written.killed, written.orphans),
        (Some(7), None, None, 0)
    );
    assert!(written.ended_ns > written.started_ns && written.max_rss_bytes > 0);
    assert!(!written.asked);
}

#[test]
fn a_runtime_that_crashes_takes_its_shim_along_by_the_same_signal() {
    use std::os::unix::process::ExitStatusExt;
    let record = Record::of("crash");
    assert_eq!(run(&record, "kill -ABRT $$").status.signal(), Some(6));
    assert_eq!(record.read().signal, Some(6));
}

#[test]
fn a_signal_to_the_shim_reaches_the_runtime() {
    let record = Record::of("term");
    let (mut shim, _) =
        start(&record, "trap 'exit 5' TERM; echo ready; while :; do sleep 0.01; done");
    kill_process(pid(shim.id()), Signal::TERM).unwrap();
    assert_eq!(shim.wait().unwrap().code(), Some(5));
    assert_eq!((record.read().code, record.read().asked), (Some(5), true));
}

#[test]
fn what_a_runtime_leaves_behind_is_ended_even_in_a_session_of_its_own() {
    let record = Record::of("left");
    let output = run(&record, "setsid sleep 1000 >/dev/null 2>&1 & echo $!");
    let left: i32 = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
    assert!(test_kill_process(pid(left)).is_err(), "process {left} still lives");
    assert!(record.read().orphans >= 1);
}

/// Runs the test `name` of this program below a shim, which kills it. Gives why, and what was said.
#[track_caller]
fn killed(name: &str) -> (Killed, String) {
    let record = Record::of(name);
    let me = std::env::current_exe().unwrap();
    let runtime = [me.to_str().unwrap(), "--exact", name];
    let output = shim(&record, &runtime).stdout(Stdio::null()).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(6), "{said}");
    let killed = record.read().killed.unwrap();
    assert!(
        said.contains(&format!("its process {}", killed.sentence()))
            && said.contains(killed.help()),
        "{said}"
    );
    (killed, said)
}

/// The page of the shim, in a test that [`killed`] starts as a runtime. By itself such a test is
/// over at once.
fn below_shim() -> Option<Pulse> {
    std::env::var_os(PULSE_ENV).map(|_| Pulse::inherited().unwrap())
}

fn hang() -> ! {
    loop {
        std::thread::park();
    }
}

#[test]
fn what_does_not_come_back_is_killed_and_the_record_says_what_it_did() {
    let (killed, _) = killed("a_runtime_that_hangs");
    assert_eq!((killed.doing, killed.at_ns, killed.allowed_ns), (Doing::Wake, 42, 50_000_000));
    assert!(killed.why == Why::Late && killed.ran_ns >= killed.allowed_ns, "{killed:?}");
}

#[test]
fn a_runtime_that_hangs() {
    let Some(pulse) = below_shim() else { return };
    let _busy = pulse.busy(Doing::Wake, Duration::from_millis(50), 42);
    hang();
}

#[test]
fn a_runtime_that_was_stopped_between_two_wakes_is_killed_though_nothing_is_overdue() {
    let (killed, said) = killed("a_runtime_that_stops_itself");
    assert_eq!((killed.doing, killed.why), (Doing::Rounds, Why::Stopped));
    assert!(killed.ran_ns >= killed.allowed_ns && !said.contains("deadline"), "{killed:?}, {said}");
}

#[test]
fn a_runtime_that_stops_itself() {
    let Some(pulse) = below_shim() else { return };
    pulse.alive(Duration::from_secs(3600));
    kill_process(getpid(), Signal::STOP).unwrap();
    hang();
}

#[test]
fn a_runtime_that_keeps_more_memory_than_its_lambda_may_is_killed_with_both_numbers() {
    const MAY: u64 = 1 << 20;
    let (killed, _) = killed("a_runtime_that_keeps_memory");
    let Why::Memory { used, allowed } = killed.why else { panic!("{killed:?}") };
    assert!(allowed == MAY && used > 40 << 20, "{used} of {allowed}");
}

#[test]
fn a_runtime_that_keeps_memory() {
    let Some(pulse) = below_shim() else { return };
    let base = Process::seen(None).unwrap().held;
    pulse.set_share(Share { base, most: 1 << 20 });
    let kept = black_box(vec![1_u8; 48 << 20]);
    pulse.alive(Duration::from_secs(3600));
    black_box(&kept);
    hang();
}

#[test]
fn memory_that_the_limit_of_data_does_not_count_any_more_is_counted_still() {
    let (killed, _) = killed("a_runtime_with_more_than_its_limit_of_data");
    let Why::Memory { used, allowed } = killed.why else { panic!("{killed:?}") };
    assert!(allowed == 8 << 20 && used > 128 << 20, "{used} of {allowed}");
}

#[test]
fn a_runtime_with_more_than_its_limit_of_data() {
    let Some(pulse) = below_shim() else { return };
    let kept = black_box(vec![1_u8; 128 << 20]);
    let bound = Some(8 << 20);
    setrlimit(Resource::Data, Rlimit { current: bound, maximum: bound }).unwrap();
    pulse.alive(Duration::from_secs(3600));
    black_box(&kept);
    hang();
}

#[test]
fn secrets_of_the_starter_are_not_handed_on() {
    let record = Record::of("secrets");
    let output = shim(&record, &["sh", "-c", "env"])
        .env("CLOUD_TOKEN", "hush")
        .env("GLEANER_X", "y")
        .output()
        .unwrap();
    let environment = String::from_utf8(output.stdout).unwrap();
    assert!(!environment.contains("hush") && environment.contains("GLEANER_X=y"), "{environment}");
}

#[test]
fn a_program_that_is_not_there_is_named() {
    let record = Record::of("nobody");
    let output = shim(&record, &["/no/such/runtime"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8(output.stderr).unwrap().contains("cannot start `/no/such/runtime`"));
}

#[test]
fn every_layer_says_whether_it_holds_here() {
    let output = Command::new(SHIM).arg("--layers").output().unwrap();
    let layers: Vec<Layer> = serde_json::from_slice(&output.stdout).unwrap();
    let names: Vec<_> = layers.iter().map(|layer| layer.name.as_str()).collect();
    let (first, later) = (
        ["new privileges", "capabilities", "system calls", "hard deadline", "control group"],
        ["files", "start of the interpreter", "processes", "sockets", "others' share", "memory"],
    );
    for name in first.into_iter().chain(later) {
        assert!(names.contains(&name), "{name} is missing in {names:?}");
    }
    // Every Linux that Gleaner runs on has these; Landlock and control groups are told as they are.
    for layer in
        layers.iter().filter(|layer| !["files", "control group"].contains(&layer.name.as_str()))
    {
        assert_eq!(layer.holds, Holds::Yes, "{layer:?}");
    }
}

#[test]
fn a_starter_that_is_not_there_any_more_gets_nothing_started() {
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
fn what_root_may_do_is_given_up_but_for_files() {
    let output = Command::new(SHIM).args(["--", "/bin/cat", "/proc/self/status"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    // Of all: reading and writing files of others.
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
