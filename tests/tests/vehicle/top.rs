//! `gleaner top`: figures as text and as JSON, over a lost connection, and on a terminal.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_tests::live::{PATIENCE, RunningProgram, descendants, signal};
use gleaner_tests::program;
use gleaner_tests::vehicle::{TestVehicle, text};
use serde_json::Value;

use super::ticker;

/// A vehicle whose lambda `first` has reported.
fn vehicle() -> TestVehicle {
    let vehicle = TestVehicle::started();
    vehicle.deploys(ticker("rust", "first").path());
    vehicle.until("a report", |vehicle| vehicle.deployment("first").status?.live);
    vehicle
}

fn top(vehicle: &TestVehicle, args: &[&str]) -> Command {
    let mut top = Command::new(program("gleaner"));
    top.arg("top").args(args).arg("--run-dir").arg(vehicle.path("run"));
    top
}

pub fn figures() {
    let mut vehicle = vehicle();
    let json = vehicle.succeeds(&["top", "--once", "--json"]);
    let json: Value = serde_json::from_str(&json).expect("one object");
    let lambda = &json["lambdas"][0];
    assert_eq!((&lambda["id"], &lambda["state"]), (&"first".into(), &"on probation".into()));
    let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("no number: {json:#}"));
    // Ten ticks a second, less those that a busy machine misses.
    let rate = number(&lambda["wakes_per_s"]);
    assert!(rate > 0.0 && rate < 20.0, "{rate}");
    assert!(number(&lambda["cpu_percent"]) >= 0.0 && number(&lambda["rss_bytes"]) > 0.0);
    for program in ["orchestrator", "supervisor"] {
        assert!(number(&json[program]["cpu_percent"]) >= 0.0, "{json:#}");
        assert!(number(&json[program]["rss_bytes"]) > 0.0, "{json:#}");
    }
    let table = vehicle.succeeds(&["top", "--once"]);
    let row = table.lines().find(|line| line.starts_with("first  on probation "));
    assert!(row.is_some() && table.contains("CPU %"), "{table}");
    let refused = vehicle.gleaner(&["top"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(["--once", "--json"].iter().all(|way| text(&refused).contains(way)));

    let follow = top(&vehicle, &["--json"]);
    let follow = RunningProgram::start(follow);
    let until = |what: &str, key: &str| {
        follow.until_line(what, |line| {
            let line: Value = serde_json::from_str(line).expect("a line is JSON");
            line.get(key).map(|_| ())
        });
    };
    until("figures", "lambdas");
    vehicle.kill_orchestrator();
    until("a poll without an answer", "unreachable");
    vehicle.start();
    until("figures again", "lambdas");
    drop(follow);

    let mut closed = top(&vehicle, &["--json"]).stdout(Stdio::piped()).spawn().expect("it starts");
    let mut line = String::new();
    BufReader::new(closed.stdout.take().expect("a pipe")).read_line(&mut line).expect("a line");
    vehicle.until("its end without a reader", |_| closed.try_wait().ok().flatten());
    vehicle.stop();
    let absent = vehicle.gleaner(&["top", "--once"]);
    assert!(text(&absent).contains("cannot reach gleaner-orchestrator"), "{}", text(&absent));
}

pub fn terminal() {
    let vehicle = vehicle();
    let page = vehicle.path("page");
    let shown = |vehicle: &TestVehicle, wanted: &str| {
        vehicle.until(&format!("{wanted:?} on the page"), |_| {
            let page = fs::read(&page).ok()?;
            String::from_utf8_lossy(&page).contains(wanted).then_some(())
        });
    };
    let ended = |vehicle: &TestVehicle, mut script: Child| {
        let status = vehicle.until("its end", |_| script.try_wait().ok().flatten());
        assert!(status.success(), "{status}");
        // The main screen, and the cursor.
        shown(vehicle, "\u{1b}[?1049l");
        shown(vehicle, "\u{1b}[?25h");
    };
    let mut script = start(&vehicle, &page, "");
    shown(&vehicle, "on probation");
    let mut keys = script.stdin.take().expect("a pipe");
    keys.write_all(b"sjq").expect("it reads keys");
    ended(&vehicle, script);

    let script = start(&vehicle, &page, "");
    shown(&vehicle, "on probation");
    signal(*descendants(script.id(), "--run-dir").last().expect("it runs"), "TERM");
    ended(&vehicle, script);
}

pub fn lost_terminal() {
    let vehicle = vehicle();
    let page = vehicle.path("page");
    // In a session of its own, it gets no SIGHUP.
    let mut script = start(&vehicle, &page, "setsid --wait ");
    vehicle.until("the page", |_| {
        String::from_utf8_lossy(&fs::read(&page).ok()?).contains("on probation").then_some(())
    });
    let top = *descendants(script.id(), "--run-dir").last().expect("it runs");
    script.kill().expect("it runs");
    script.wait().expect("it was killed");
    let program = Path::new("/proc").join(format!("{top}/exe"));
    vehicle.until("the end of `gleaner top`", |_| fs::read_link(&program).is_err().then_some(()));
}

pub fn readers() {
    let vehicle = vehicle();
    for args in [&["events", "--follow"][..], &["logs", "first", "--follow"], &["top", "--json"]] {
        let mut follow = Command::new(program("gleaner"));
        follow.env("GLEANER_RUN", vehicle.path("run")).args(args).stdout(Stdio::piped());
        let mut follow = follow.spawn().expect("it starts");
        let mut reader = BufReader::new(follow.stdout.take().expect("a pipe"));
        reader.read_line(&mut String::new()).expect("a line");
        // Nothing comes any more.
        signal(vehicle.orchestrator(), "STOP");
        drop(reader);
        let deadline = Instant::now() + PATIENCE;
        let ended = loop {
            if let Some(ended) = follow.try_wait().expect("our child") {
                break Some(ended);
            }
            if Instant::now() > deadline {
                break None;
            }
            thread::sleep(Duration::from_millis(10));
        };
        signal(vehicle.orchestrator(), "CONT");
        let _ = follow.kill();
        assert!(ended.is_some_and(|ended| ended.success()), "{args:?}: {ended:?}");
    }
}

/// Starts `gleaner top` on a terminal of 80 columns, whose output goes to `page`, by the program
/// `by`.
fn start(vehicle: &TestVehicle, page: &Path, by: &str) -> Child {
    File::create(page).expect("the folder is writable");
    let (gleaner, run) = (program("gleaner"), vehicle.path("run"));
    let top = format!(
        "stty rows 24 cols 80; exec {by}{} top --run-dir {}",
        gleaner.display(),
        run.display()
    );
    let mut script = Command::new("script");
    script.args(["--quiet", "--flush", "--return", "--command", &top]).arg(page);
    script.stdin(Stdio::piped()).stdout(Stdio::null()).spawn().expect("util-linux has `script`")
}
