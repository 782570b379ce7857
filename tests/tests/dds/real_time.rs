//! Real-time priority of the ingress, which no other process gets.

use std::collections::BTreeSet;
use std::fs;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_protocol::process_stats::usage::ProcessUsage;
use gleaner_tests::live::{PATIENCE, RunningProgram, descendants, run_all, run_by};
use gleaner_tests::vehicle::TestVehicle;
use gleaner_tests::{LambdaCopy, TempFolder, program, root};
use libtest_mimic::Failed;

use crate::{DdsCase, Need, case};

pub const CASES: &[DdsCase] = &[
    case("the_ingress_alone_has_real_time_priority", &[Need::RealTime], ingress_alone),
    case("memory_for_images_is_mapped_before_they_arrive", &[Need::RealTime], memory_is_mapped),
    case("without_the_permission_the_ingress_warns_and_receives", &[Need::RealTime], not_permitted),
    case("the_ingress_of_a_vehicle_has_it_if_its_file_says_so", &[Need::RealTime], of_a_vehicle),
];

/// Policies of `sched(7)`, as `/proc/PID/stat` has them.
const NORMAL: &str = "0";
const FIFO: &str = "1";

/// A program without the capability to take real-time priority.
const WITHOUT: [&str; 2] = ["--bounding-set", "-sys_nice"];

/// Returns why cases that need [`Need::RealTime`] cannot run here, if they cannot.
pub fn unavailable() -> Option<&'static str> {
    let succeeds = |command: &mut Command| {
        let status = command.stdin(Stdio::null()).stderr(Stdio::null()).status();
        status.is_ok_and(|status| status.success())
    };
    let takes = ["chrt", "-f", "1", "true"];
    let permitted = succeeds(Command::new(takes[0]).args(&takes[1..]));
    let denied = !succeeds(Command::new("setpriv").args(WITHOUT).args(takes))
        && succeeds(Command::new("setpriv").args(WITHOUT).arg("true"));
    (!permitted || !denied).then_some("cannot take real-time priority, and give it up by setpriv")
}

fn ingress_alone() -> Result<(), Failed> {
    let out = TempFolder::new();
    let lambda = root().join("tests/lambdas/ticker/python");
    // That of the starter is kept by none.
    let mut gleaner = Command::new("chrt");
    gleaner.args(["-f", "2"]).arg(program("gleaner"));
    let running = run_by(gleaner, &[&lambda], out.path(), &["--no-record", "--real-time"]);
    running.until_ready();
    assert_eq!(policies(running.pid()), BTreeSet::from([FIFO.to_owned()]));
    let mut names = BTreeSet::new();
    for pid in descendants(running.pid(), "") {
        let process = |file| fs::read_to_string(format!("/proc/{pid}/{file}")).unwrap();
        let name = process("comm").trim_end().to_owned();
        let policy = if name == "gleaner-ingress" { FIFO } else { NORMAL };
        assert_eq!(policies(pid), BTreeSet::from([policy.to_owned()]), "{name}");
        let limits = process("limits");
        let limit = limits.lines().find(|line| line.starts_with("Max realtime priority"));
        assert_eq!(limit.unwrap().split_whitespace().nth(3), Some("0"), "{name}");
        names.insert(name);
    }
    for name in ["gleaner-ingress", "gleaner-shim"] {
        assert!(names.contains(name), "{names:?}");
    }
    assert!(until_end(running, 0), "the status has the priority");
    assert!(doctor_permits(Command::new(program("gleaner"))));
    Ok(())
}

/// Topics that together need more than the most that is mapped: 192 MiB for each.
fn memory_is_mapped() -> Result<(), Failed> {
    let out = TempFolder::new();
    let lambdas =
        ["slow", "pixels"].map(|name| root().join(format!("tests/lambdas/{name}/python")));
    let lambdas = [&*lambdas[0], &*lambdas[1]];
    let running = run_all(&lambdas, out.path(), &["--no-record", "--real-time"]);
    running.until_all_ready(2);
    let [ingress] = descendants(running.pid(), "gleaner-ingress")[..] else {
        return Err("there is one ingress".into());
    };
    let mapped = || ProcessUsage::of(Some(ingress)).expect("it runs").held >> 20;
    // A topic may be subscribed to after `init` has returned. Page tables take less than 2 MiB.
    let deadline = Instant::now() + PATIENCE;
    while mapped() < 256 + 2 {
        assert!(Instant::now() < deadline, "{} MiB", mapped());
        sleep(Duration::from_millis(20));
    }
    assert!(mapped() < 320, "{} MiB", mapped());
    let finished = running.interrupt();
    assert!(finished.status.success(), "{}", finished.stderr);
    Ok(())
}

fn not_permitted() -> Result<(), Failed> {
    let out = TempFolder::new();
    let lambda = root().join("tests/lambdas/ticker/python");
    let gleaner = || {
        let mut gleaner = Command::new("setpriv");
        gleaner.args(WITHOUT).arg(program("gleaner"));
        gleaner
    };
    assert!(!doctor_permits(gleaner()));
    let running = run_by(gleaner(), &[&lambda], out.path(), &["--no-record", "--real-time"]);
    running.until_ready();
    assert!(!until_end(running, 1), "the status has no priority");
    Ok(())
}

fn of_a_vehicle() -> Result<(), Failed> {
    let mut vehicle = TestVehicle::new();
    fs::write(vehicle.path("vehicle.toml"), "[network]\nreal_time = true\n").unwrap();
    vehicle.start();
    let lambda = LambdaCopy::named("tests/lambdas/ticker/rust", "ticker");
    vehicle.deploys(lambda.path());
    vehicle.until_running(&["ticker"]);
    let [ingress] = vehicle.processes("gleaner-ingress")[..] else {
        return Err("there is one ingress".into());
    };
    assert_eq!(policies(ingress), BTreeSet::from([FIFO.to_owned()]));
    vehicle.stop();
    Ok(())
}

/// Returns whether `gleaner doctor` finds real-time priority permitted.
fn doctor_permits(mut gleaner: Command) -> bool {
    let output = gleaner.arg("doctor").stdin(Stdio::null()).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let line = text.lines().find(|line| line.contains("real time:")).expect("a finding");
    let (_, detail) = line.split_once("real time: ").unwrap();
    let denied = detail.starts_with("not permitted to this user; only `gleaner run --real-time`");
    assert!(denied || detail == "permitted to this user", "{text}");
    !denied
}

/// Ends the program after a status of its network; returns whether that has real-time priority.
/// There were `warnings` that it is refused.
fn until_end(running: RunningProgram, warnings: usize) -> bool {
    running.until_live("a status of the network", |live| live.network.buffer_granted > 0);
    let finished = running.interrupt();
    assert!(finished.status.success(), "{}", finished.stderr);
    let refused = finished.stderr.matches("refuses real-time priority").count();
    assert_eq!(refused, warnings, "{}", finished.stderr);
    finished.ended().network.real_time
}

/// The scheduling policies of the threads of a process.
fn policies(pid: u32) -> BTreeSet<String> {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let policy = |thread: fs::DirEntry| {
        let stat = fs::read_to_string(thread.path().join("stat")).ok()?;
        // `policy` is the 41st field; the name, which is the second one, may contain spaces.
        Some(stat.rsplit_once(')')?.1.split_whitespace().nth(38)?.to_owned())
    };
    threads.filter_map(policy).collect()
}
